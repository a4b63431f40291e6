"""Foothold layers of a height map as a picture: heights, Lotriet's score, Masri's evaluation function.

python examples/foothold_layers.py footholds.png [map.npy]

Without a map it draws steps of 2 to 10 cm. `sextant recording export RUN --map map.npy` writes that of a run, in cells of 1 cm.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import sextant

if len(sys.argv) > 2:
    heights = np.load(sys.argv[2]).astype(np.float32)
else:
    heights = np.zeros((200, 120), np.float32)
    for k, rise in enumerate((0.02, 0.04, 0.06, 0.08, 0.10)):
        heights[20 + 36 * k : 38 + 36 * k, 30:90] = rise

layers = sextant.FootholdLayers(heights.shape, 0.01)
found = layers.update(heights, np.full_like(heights, 1e-6), np.zeros(2, np.int64))
score = found.score  # 0 is best, above 1 is no foothold, NaN is unknown
evaluation = np.where(found.evaluation == 127, np.nan, found.evaluation)  # [cells], negative is a foothold
print(
    f"{np.isfinite(score).sum()} cells are known; {(score <= 1).sum()} carry a foot by the score, "
    f"{(evaluation < 0).sum()} by the evaluation function"
)

figure = Figure(figsize=(9, 6), layout="constrained")
panels = figure.subplots(1, 3)
for axes, layer, title, limits in zip(
    panels, (heights, score, evaluation), ("height [m]", "score", "evaluation [cells]"), (None, (0, 2), (-5, 5)), strict=True
):
    drawn = axes.imshow(layer, cmap="viridis", vmin=limits and limits[0], vmax=limits and limits[1])
    axes.set_title(title)
    figure.colorbar(drawn, ax=axes, shrink=0.6)
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "footholds.png")
