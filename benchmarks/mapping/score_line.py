"""One line of JSON from the `surface` part of `skclam evaluate --json`: RIG VOXEL_MM FILE."""

import json
import sys

rig, voxel_mm, path = sys.argv[1:]
with open(path) as file:
    surface = json.load(file)["surface"]
line = {"rig": rig, "voxel_mm": float(voxel_mm)}
for what in ("accuracy", "completeness"):
    distances = surface[what]
    line[what] = {
        "median_mm": round(distances["median_m"] * 1e3, 3),
        "p90_mm": round(distances["p90_m"] * 1e3, 3),
        "within_5_10_20_mm": [round(share, 4) for share in distances["within"]],
    }
line["f_score_5_10_20_mm"] = [round(share, 4) for share in surface["f_score"]]
print(json.dumps(line))
