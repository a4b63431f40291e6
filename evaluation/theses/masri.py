"""Inventory of Masri's figures and tables."""

from functools import partial

from sextant.evaluation.theses import masri_crossings as crossings
from sextant.evaluation.theses import masri_motion as motion
from sextant.evaluation.theses import masri_terrain as terrain
from sextant.evaluation.theses.inventory import Entry, Thesis, numbers, undrawn

_SCANS = "pictures of the simulated camera over `passage1`"
_HIS_MAP = f"his mapping as published, on {_SCANS}"
_HIS_PLANNER = "his planner as published, with assumed numbers"
_WORDS = ("first", "second", "third")


def _of_layout(number: int) -> list[Entry]:
    """Return the figures of one scenario: start, crossing and maps."""
    layout, word = f"passage{number}", _WORDS[number - 1]
    start, crossing, maps = (("6.2", "6.3", "6.4"), ("6.5", "6.7", "6.6"), ("6.8", "6.9", "6.10"))[number - 1]
    walk = f"walks over `{layout}`"
    return [
        Entry(start, f"the robot in front of the {word} scenario", partial(crossings.draw_start, layout=layout),
              walks=(layout,), size=(7.0, 3.6), ours=f"walk over `{layout}`"),
        Entry(crossing, f"crossing of the {word} scenario", partial(crossings.draw_crossing, layout=layout),
              walks=(layout,), trials=crossings.TRIALS, size=(7.4, 1.9), ours=walk,
              printed=numbers(("successful trials", "3 of 3"), ("plannings of a crossing", "3"))),
        Entry(maps, f"map and foothold map of the {word} scenario", partial(crossings.draw_maps, layout=layout),
              walks=(layout,), trials=crossings.TRIALS, size=(6.6, 5.6), ours=walk,
              printed=numbers(("footholds on the bridges", "in their centres"))),
    ]  # fmt: skip


_DRAWN = (
    Entry("2.12", "depth picture (there are no dots of a projector)", terrain.draw_depth, size=(5.6, 3.4), ours=_SCANS,
          printed=numbers(("resolution", "640 x 480"), ("nearest depth", "about 0.5 m"))),
    Entry("3.1", "the robot and its coordinate system", motion.draw_robot, size=(7.2, 3.2), ours="the profile",
          printed=numbers(("body", "240 x 120 x 39 mm"))),
    Entry("3.5", "limits of femur and tibia", motion.draw_space, size=(7.0, 3.3), ours="the profile",
          printed=numbers(("range of the coxa (Table 3.2)", "122, 160 deg"), ("femur", "205 to 206 deg"),
                          ("tibia", "154 to 160 deg"))),
    Entry("4.1", "expected motion and registration", terrain.draw_translation, size=(7.2, 4.0), ours=_HIS_MAP),
    Entry("4.3", "terrain in front of the robot, and its raw point cloud", terrain.draw_cloud, size=(7.4, 3.0), ours=_SCANS,
          printed=numbers(("points of a scan", "307200"))),
    Entry("4.4", "reduction of the point cloud", terrain.draw_reduction, size=(7.4, 3.2), ours=_HIS_MAP,
          printed=numbers(("points", "not given"))),
    Entry("4.5", "registration of points and with normals", terrain.draw_normals, size=(7.2, 4.0), ours=_HIS_MAP,
          printed=numbers(("points", "differs by centimetres"), ("with normals", "better"))),
    Entry("4.6", "cloud, elevation map, accessible areas", terrain.draw_steps, size=(7.6, 3.2), ours=_HIS_MAP,
          printed=numbers(("cells", "1 cm, 2.7 x 1.0 m"))),
    Entry("4.7", "evaluation function across a pillar", partial(terrain.draw_pillar, thresholded=False), size=(6.0, 3.2),
          ours="his mapping as published, on a pillar of 30 cm"),
    Entry("4.8", "dilation and closing of the foothold map", terrain.draw_closing, size=(7.4, 3.0), ours=_HIS_MAP,
          printed=numbers(("structure element", "5 x 5 pixels"), ("cells", "not given"))),
    Entry("4.10", "evaluation function", terrain.draw_evaluation, size=(6.4, 3.4), ours=_HIS_MAP,
          printed=numbers(("threshold", "-5"))),
    Entry("4.11", "thresholded evaluation function across a pillar", partial(terrain.draw_pillar, thresholded=True),
          size=(6.0, 3.2), ours="his mapping as published, on a pillar of 30 cm", printed=numbers(("threshold", "-5"))),
    Entry("4.12", "perception from the walking and a raised body", terrain.draw_heights, size=(7.4, 3.0), ours=_SCANS,
          printed=numbers(("raised by", "about 7 cm"), ("walking state", "not sufficient"), ("raised", "much better"))),
    Entry("4.14", "assumed ground at the start", terrain.draw_start, walks=("passage1",), size=(6.0, 3.4),
          ours="the first map of a walk over `passage1`", printed=numbers(("measured ground", "from 0.5 m ahead"))),
    Entry("5.2", "samples of the body's motion", motion.draw_body_motion, size=(6.0, 3.4), ours=_HIS_PLANNER),
    Entry("5.3", "samples of a foot's motion", motion.draw_foot_motion, size=(6.4, 3.4), ours=_HIS_PLANNER),
    Entry("5.4", "a swing moved into the reach of the leg", motion.draw_reach, size=(6.4, 3.4), ours="profile and his rule"),
    Entry("5.5", "a swing raised over the ground", motion.draw_proximity, size=(6.4, 3.2), ours="his rule, and our swing",
          printed=numbers(("least distance", "2 cm"))),
    Entry("5.6", "consecutive configurations of a step", motion.draw_configurations, size=(6.8, 3.6), ours=_HIS_PLANNER),
    Entry("6.1", "the three scenarios", crossings.draw_layouts, size=(7.0, 3.6), ours="the grounds of `passage1` to `passage3`",
          printed=numbers(("pillars, first", "6"), ("second", "6"), ("third", "5"), ("gap of the third", "10 cm"))),
    *_of_layout(1), *_of_layout(2), *_of_layout(3),
    Entry("Table 6.1", "planning in three scenarios", crossings.draw_table, size=(7.6, 3.9),
          ours="his planner and ours on the true ground"),
)  # fmt: skip

_UNDRAWN = (
    *undrawn("a photograph", ("1", "a walking robot"), ("2", "natural ground"), ("1.1", "computer and camera on the robot"),
             ("1.2", "the testbed"), ("2.1", "PhantomX"), ("2.2", "AX-12A"), ("2.7", "boards"), ("2.8", "adapter"),
             ("2.9", "PhantomX"), ("2.10", "parts of a leg"), ("2.11", "Xtion PRO"), ("2.13", "Odroid U3"),
             ("4.13", "two body heights; 4.12 has what the camera sees from both")),
    *undrawn("a drawing from the data sheet of the servo", ("2.3", "range of the servo"), ("2.5", "instruction packet"),
             ("2.6", "status packet")),
    *undrawn("a sketch that defines symbols, without data", ("2.4", "ids of the servos"), ("3.2", "geometrical model; see 3.1"),
             ("3.3", "angles of a leg"), ("3.4", "directions of the angles"), ("4.9", "local masks"),
             ("5.1", "idea of the planner; see 5.6")),
    *undrawn("a diagram of his software, without data", ("4.2", "data flow")),
    *undrawn("a table of constants, without a result", ("Table 2.1", "the servo"), ("Table 2.2", "addresses"),
             ("Table 2.3", "errors"), ("Table 2.4", "Odroid U3"), ("Table 3.1", "offsets of the angles"),
             ("Table 3.2", "limits of the servos; 3.5 has their ranges"), ("Table A.1", "files")),
)  # fmt: skip

MASRI = Thesis(
    "masri",
    "D. Masri, Terrain Modeling and Motion Planning for Hexapod Walking Robot Control, CTU Prague 2016",
    (*_DRAWN, *_UNDRAWN),
)
