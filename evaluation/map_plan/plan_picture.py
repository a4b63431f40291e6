"""Picture of a plan on a map."""

from pathlib import Path

import numpy as np

from sextant.evaluation.figures.layers_picture import figure_of
from sextant.evaluation.map_plan.map_walk import MapPlan
from sextant.shared.files import whole_files


def draw_plan(path: Path, plan: MapPlan) -> None:
    """Draw height, score and evaluation function of the map, with the way of the body and the footholds of each leg."""
    way = np.array([move.T_map_body for move in (plan.start, *plan.moves)])
    figure = figure_of(plan.terrain, way, plan.footholds())
    assert figure is not None  # the robot stands on known ground
    for axes in figure.axes[:3]:
        axes.plot(*plan.start.T_map_body[:2, 3], "o", color="#d01c8b", ms=7)
        axes.plot(*plan.goal, "*", color="#d01c8b", ms=13, markeredgecolor="white")
    figure.suptitle(f"{'goal reached' if plan.reached else 'goal not reached'} · {plan.length:.2f} m · {len(plan.moves)} moves")
    whole_files.make_folder(path.parent)
    whole_files.write_by_name(path, figure.savefig)
