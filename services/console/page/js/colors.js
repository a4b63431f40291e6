// Colour maps of the map layers, with 256 colours each, and the labels at both ends of their legends.

const UNKNOWN = [74, 84, 92];

function ramp(stops) {
  // stops: [[place 0..254, [r, g, b]], ...] in rising order
  const table = new Uint8Array(256 * 4);
  for (let i = 0; i < 255; i++) {
    let k = 0;
    while (k < stops.length - 2 && i > stops[k + 1][0]) k++;
    const [a, from] = stops[k];
    const [b, to] = stops[k + 1];
    const t = Math.min(1, Math.max(0, (i - a) / Math.max(1, b - a)));
    for (let c = 0; c < 3; c++) table[4 * i + c] = Math.round(from[c] + t * (to[c] - from[c]));
    table[4 * i + 3] = 255;
  }
  table.set([...UNKNOWN, 255], 4 * 255);
  return table;
}

const GOOD = [60, 158, 122];
const FAIR = [222, 203, 94];
const POOR = [224, 130, 62];
const NONE = [138, 42, 42];

export const TABLES = {
  score: ramp([[0, GOOD], [60, FAIR], [99, POOR], [100, NONE], [254, [88, 26, 30]]]), // a cell is a foothold below 100
  evaluation: ramp([[0, [36, 120, 170]], [15, GOOD], [24, FAIR], [25, NONE], [50, [70, 24, 30]], [254, [70, 24, 30]]]),
  variance: ramp([[0, [38, 60, 110]], [60, [52, 140, 150]], [140, FAIR], [254, [226, 90, 60]]]),
};

export const LEGENDS = {
  score: ["good foothold", "none"],
  evaluation: ["far from edges", "none"],
  variance: ["sure", "± 2 cm"],
  color: ["as the camera sees it", ""],
};

/** Last index (0 to 254) of each table that the legend shows. */
export const SHOWN = { score: 140, evaluation: 50, variance: 254 };
