"""The table of issue 5 in Markdown from the log of `run.sh`: LOG."""

import json
import sys

with open(sys.argv[1]) as file:
    log = {entry["name"]: entry["result"] for entry in map(json.loads, file)}


def row(*cells):
    print("| " + " | ".join(str(cell) for cell in cells) + " |")


def beside(what, limit, name, key, form):
    ours, large, small = (log[f"{name} {program}"][key] for program in ("ours", "open3d-16", "open3d-8"))
    ratios = " / ".join(f"{ours / other:.2f}" for other in (large, small))
    row(what, format(ours, form), format(large, form), format(small, form), ratios, limit)


print()
row("what", "ours", "Open3D, blocks of 16^3", "of 8^3", "ours / Open3D's", "to reach")
row(*["---"] * 6)
for where, size in (("cell", "480x360"), ("shelf", "640x480")):
    for voxel in (10, 5):
        name = f"{where} {voxel}"
        beside(f"integration, CPU ms an image, {size}, {voxel} mm", "0.5, aim 0.25", name, "integrate_cpu_ms", ".1f")
        beside("the same, wall-clock, mean", "", name, "integrate_mean_ms", ".1f")
        beside("the same, wall-clock, median", "", name, "integrate_median_ms", ".1f")
        beside(f"extraction, wall-clock ms, {size}, {voxel} mm", "0.5", name, "extract_ms", ".0f")
        beside(f"peak memory, MiB, {size}, {voxel} mm", "0.7", name, "peak_mib", "d")
print()
row("against `truth/scene.ply`, true poses", "ours", "Open3D, weight >= 3", "weight >= 1")
row(*["---"] * 4)
for voxel in (10, 5):
    scores = [log[f"score {voxel} {map}"] for map in ("ours", "theirs", "theirs1")]
    row(f"accuracy, median, mm, {voxel} mm", *(f"{score['accuracy']['median_m'] * 1e3:.2f}" for score in scores))
    row(f"accuracy, 90 %, mm, {voxel} mm", *(f"{score['accuracy']['p90_m'] * 1e3:.2f}" for score in scores))
    for place, reach in enumerate((5, 10, 20)):
        shares = (f"{score['completeness']['within'][place]:.3f}" for score in scores)
        row(f"complete within {reach} mm, {voxel} mm", *shares)
    row(f"F-score at 5 / 10 / 20 mm, {voxel} mm", *(" / ".join(f"{f:.3f}" for f in score["f_score"]) for score in scores))
print()
row("our map by the poses of", "the true rig", "the calibrated rig", "the nominal rig", "calibrated / true", "to reach")
row(*["---"] * 6)
for voxel in (10, 5):
    rigs = [log[f"rig {voxel} {rig}"] for rig in ("truth", "calibrated", "nominal")]
    for what in ("accuracy", "completeness"):
        for key, name in (("median_mm", "median"), ("p90_mm", "90 %")):
            values = [rig[what][key] for rig in rigs]
            ratio = f"{values[1] / values[0]:.3f}"
            row(f"{what}, {name}, mm, {voxel} mm", *(f"{value:.2f}" for value in values), ratio, "1.05")
print()
once, long, flat = log["memory once"], log["memory long"], log["flat"]
row("a long run", "at first", "at the end", "ratio", "to reach")
row(*["---"] * 5)
first, last = flat["first_100_ms"], flat["last_100_ms"]
row(f"ms an image, first and last 100 of {flat['images']}", first, last, f"{last / first:.2f}", "1.1")
ratio = f"{long['peak_mib'] / once['peak_mib']:.2f}"
row(f"peak MiB after {once['images']} and {long['images']} images", once["peak_mib"], long["peak_mib"], ratio, "1")
row("blocks", once["blocks"], long["blocks"], f"{long['blocks'] / once['blocks']:.2f}", "1")
