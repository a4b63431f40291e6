"""Inventory of Lotriet's figures and tables."""

from functools import partial
from types import MappingProxyType

from sextant.evaluation.theses import lotriet_gait as gait
from sextant.evaluation.theses import lotriet_maps as maps
from sextant.evaluation.theses import lotriet_scores as scores
from sextant.evaluation.theses import lotriet_swings as swings
from sextant.evaluation.theses import lotriet_walks as walks
from sextant.evaluation.theses.inventory import Entry, Thesis, numbers, undrawn

_FLAT, _STAIRS, _ORGANIC, _PAST = "lotriet_flat", "lotriet_stairs", "lotriet_organic", "lotriet_walk_past"
_OF_WALK = MappingProxyType({name: numbers(*walks.printed(name)) for name in (_FLAT, _STAIRS, _ORGANIC)})
_FUNCTION = "computed: the published function and ours"
_GROUND = "computed on the ground of `lotriet_scoring`, whose sizes are ours"


def _walk(name: str) -> str:
    return f"walk over `{name}`"


_DRAWN = (
    Entry("3.5", "the simulation", maps.draw_simulation, walks=(_STAIRS,), size=(7.0, 4.0), ours=_walk(_STAIRS)),
    Entry("4.4", "objects of the mapping test from above", maps.draw_setup, walks=(_PAST,), size=(7.0, 3.9),
          ours=f"{_walk(_PAST)}, with objects of our sizes"),
    *(Entry(number, f"camera and height map at the {moment} of the walk", partial(maps.draw_map, moment=moment),
            walks=(_PAST,), size=(7.4, 2.8), ours=_walk(_PAST))
      for number, moment in (("4.5", "start"), ("4.6", "middle"), ("4.7", "end"))),
    Entry("4.8", "pose estimates of the walk", maps.draw_poses, walks=(_PAST,), size=(7.4, 3.2), ours=_walk(_PAST),
          printed=numbers(("rate of the poses (Table B.3)", "15 Hz"), ("steps between estimates", "sometimes large"))),
    Entry("5.4", "gaits: which leg swings when", gait.draw_gaits, size=(7.0, 2.3), ours="the gaits of the planner",
          printed=numbers(("duty factor, wave", "5/6 = 0.833"), ("ripple", "2/3 = 0.667"), ("tripod", "1/2 = 0.500"))),
    Entry("5.5", "a stride in the frame of the body", partial(gait.draw_stride, frame="body"), walks=(_FLAT,),
          size=(7.0, 3.4), ours=_walk(_FLAT)),
    Entry("5.6", "the same stride in the world", partial(gait.draw_stride, frame="world"), walks=(_FLAT,),
          size=(7.0, 3.4), ours=_walk(_FLAT),
          printed=numbers(("way of a swinging foot, against 5.5", "double"))),
    Entry("5.8", "sextants, and the legs that swing", gait.draw_sextants, size=(7.2, 3.8), ours="computed by his rule",
          printed=numbers(("swinging legs with sextant 1 active", "1, 3, 5"))),
    Entry("5.11", "the sixth-order arc", swings.draw_arc, size=(5.0, 3.0), ours="computed by (5.21) and (5.22)",
          printed=numbers(("distance from q_m halfway", "passes through it"))),
    Entry("5.12", "the arc that is computed again halfway", swings.draw_second_rise, size=(6.0, 3.4), ours=_FUNCTION),
    Entry("5.13", "directions of the flow function", swings.draw_field, size=(6.0, 3.6), ours="computed by (5.23) to (5.26)"),
    Entry("5.14", "the sigmoid-like function", swings.draw_sigmoid, size=(5.0, 3.0), ours="computed by (5.26)",
          printed=numbers(("range", "about -1 to 0"))),
    *(Entry(number, f"swings to a target {where}", partial(swings.draw_paths, rise=rise), size=(6.0, 3.6), ours=_FUNCTION)
      for number, where, rise in (("5.15", "at the height of the start", 0.0), ("5.16", "above it", 50.0),
                                  ("5.17", "below it", -50.0))),
    Entry("5.18", "a target that moves away and down in the swing",
          partial(swings.draw_changed_target, rises=(0.0, -50.0), shift=40.0), size=(6.0, 3.4), ours=_FUNCTION),
    Entry("5.19", "a target that moves nearer and up in the swing",
          partial(swings.draw_changed_target, rises=(-50.0, 30.0), shift=-30.0), size=(6.0, 3.4), ours=_FUNCTION),
    Entry("6.1", "slope score over a slice of ground", scores.draw_slope_slice, size=(6.0, 3.2), ours="computed by (6.3)"),
    Entry("6.2", "edge proximity score over a slice", scores.draw_proximity_slice, size=(6.0, 3.2), ours="computed by (6.4)"),
    Entry("6.3", "order of the search", scores.draw_search, size=(5.6, 2.8), ours="computed by his order and ours",
          printed=numbers(("cells for a search diameter of 5", "25 cells"))),
    Entry("6.4", "floor height", scores.draw_floor, walks=(_STAIRS,), size=(6.4, 3.4), ours=_walk(_STAIRS)),
    Entry("6.5", "ground of the scoring test and its height map", scores.draw_terrain, size=(7.4, 3.3), ours=_GROUND),
    Entry("6.6", "slope and edge proximity apart", scores.draw_terms, size=(7.0, 3.3), ours=_GROUND),
    Entry("6.7", "the walkability score", scores.draw_score, size=(7.0, 3.3), ours=_GROUND),
    Entry("6.8", "nominal footholds and the chosen ones", scores.draw_picks, size=(6.6, 5.0), ours=_GROUND,
          printed=numbers(("middle left, level ground", "stays"), ("top right, too near a box", "moves away from it"),
                          ("bottom right", "moves onto the ramp"), ("middle right", "moves onto the pedestal"),
                          ("top left", "moves to the top of the pillar"), ("bottom left", "moves to the bottom of the hole"))),
    Entry("6.9", "map of the robot and its score", scores.draw_walked_map, walks=(_PAST,), size=(7.4, 3.2),
          ours=f"{_walk(_PAST)}: the map of the simulated robot, not of a real one"),
    Entry("6.10", "nominal footholds on the map of the robot", scores.draw_walked_picks, walks=(_PAST,), size=(5.4, 5.0),
          ours=f"{_walk(_PAST)}: the map of the simulated robot, not of a real one"),
    *(Entry(number, f"pictures of the walk over {where}", partial(walks.draw_pictures, scenario=name), walks=(name,),
            size=(7.0, 5.5), ours=_walk(name))
      for number, where, name in (("8.1", "level ground", _FLAT), ("8.3", "stairs", _STAIRS), ("8.5", "cobbles", _ORGANIC))),
    *(Entry(number, f"{where}: body height, tilt and one foot", partial(walks.draw_walk, scenario=name), walks=(name,),
            printed=_OF_WALK[name], size=(7.0, 5.4), ours=_walk(name))
      for number, where, name in (("8.2", "level ground", _FLAT), ("8.4", "stairs", _STAIRS))),
    Entry("8.6", "cobblestones: feet from above and from the side", partial(walks.draw_feet, scenario=_ORGANIC),
          walks=(_ORGANIC,), size=(7.0, 5.0), ours=_walk(_ORGANIC)),
    Entry("8.7", "cobblestones: body height and tilt", partial(walks.draw_height_and_tilt, scenario=_ORGANIC),
          walks=(_ORGANIC,), printed=_OF_WALK[_ORGANIC], size=(7.0, 3.8), ours=_walk(_ORGANIC)),
)  # fmt: skip

_UNDRAWN = (
    *undrawn("a photograph", ("2.1", "a fly"), ("2.2", "a circular hexapod"), ("3.1", "his robot")),
    *undrawn("from another publication", ("2.3", "trends of control"), ("2.4", "traversability"), ("2.5", "terrain scoring")),
    *undrawn("a diagram of his software, without data", ("3.2", "basic operation"), ("3.3", "advanced operation"),
             ("3.4", "physical system"), ("4.3", "pipeline on the GPU"), ("5.1", "motion system"), ("5.7", "state machine"),
             ("7.1", "nodes of ROS"), ("Table 5.1", "states"),
             *((f"Table B.{k}", "messages of ROS") for k in range(1, 8))),
    *undrawn("a sketch that defines symbols, without data", ("4.1", "projection of the camera"), ("4.2", "circular buffer"),
             ("5.2", "coordinate frames"), ("5.3", "frame of a leg"), ("5.9", "targets of supporting legs"),
             ("5.10", "targets of swinging legs")),
)  # fmt: skip

LOTRIET = Thesis(
    "lotriet",
    "A. P. Lotriet, Foot Placement Planning of a Hexapod Robot Moving Over Uneven Terrain, Stellenbosch 2024",
    (*_DRAWN, *_UNDRAWN),
)
