"""Open3D's VoxelBlockGrid on the CPU over a dataset at its known poses; one line of JSON on stdout.

Same images, poses and voxel as `benchmark_fusion`; Open3D's defaults else (truncation 8 voxels, weight threshold 3).
Usage: open3d_fusion.py DATASET VOXEL_MM OUT.ply [BLOCK_RESOLUTION] [PASSES] [OUT_OF_WEIGHT_1.ply]
The last file gets the surface of all voxels that at least one image saw; the default asks for three.
"""

import csv
import json
import os
import sys
import time
import tomllib

import numpy as np
import open3d as o3d
import open3d.core as o3c


def memory_mib(name):
    for line in open("/proc/self/status"):
        if line.startswith(name):
            return int(line.split()[1]) // 1024
    return 0


def matrix(translation_m, q):
    x, y, z, w = np.asarray(q, float) / np.linalg.norm(q)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = translation_m
    return out


def intrinsic(table):
    return o3c.Tensor([[table["fx"], 0, table["cx"]], [0, table["fy"], table["cy"]], [0, 0, 1]], o3c.float64)


def main():
    folder, voxel_mm, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
    resolution = int(sys.argv[4]) if len(sys.argv) > 4 else 16
    passes = int(sys.argv[5]) if len(sys.argv) > 5 else 1
    out_of_weight_1 = sys.argv[6] if len(sys.argv) > 6 else None
    rig = tomllib.load(open(os.path.join(folder, "rig.toml"), "rb"))
    shift = rig["depth"].get("color_from_depth")
    color_from_depth = matrix(np.array(shift["translation_mm"]) / 1000, shift["quaternion_xyzw"]) if shift else np.eye(4)
    mount = matrix(np.array(rig["mount"]["translation_mm"]) / 1000, rig["mount"]["quaternion_xyzw"])
    rows = list(csv.DictReader(open(os.path.join(folder, "postures.csv"))))
    truth = os.path.join(folder, "truth/trajectory.txt")
    if os.path.exists(truth):
        lines = [[float(n) for n in line.split()] for line in open(truth) if not line.startswith("#")]
        poses = [matrix(n[1:4], n[4:8]) for n in lines]
    else:
        poses = [
            matrix([float(r[k]) / 1000 for k in ("x_mm", "y_mm", "z_mm")], [float(r[k]) for k in ("qx", "qy", "qz", "qw")])
            @ mount
            for r in rows
        ]
    device = o3c.Device("CPU:0")
    depth_k, color_k = intrinsic(rig["depth"]), intrinsic(rig["color"])
    images = []
    for row, base_from_color in zip(rows, poses):
        depth = o3d.t.io.read_image(os.path.join(folder, row["depth"]))
        color = o3d.t.io.read_image(os.path.join(folder, row["color"]))
        if color.channels == 4:
            color = o3d.t.geometry.Image(color.as_tensor()[:, :, :3].contiguous())
        extrinsic = o3c.Tensor(np.linalg.inv(base_from_color @ color_from_depth), o3c.float64)
        images.append((depth, color, extrinsic))
    scale, farthest = 1000.0 / rig["depth"]["unit_mm"], 4.0
    before_mib = memory_mib("VmRSS:")

    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (o3c.float32, o3c.float32, o3c.float32),
        ((1), (1), (3)),
        voxel_size=voxel_mm / 1000,
        block_resolution=resolution,
        block_count=10000,
        device=device,
    )
    times = []
    cpu_start = time.process_time()
    for _ in range(passes):
        for depth, color, extrinsic in images:
            start = time.perf_counter()
            coordinates = grid.compute_unique_block_coordinates(depth, depth_k, extrinsic, scale, farthest)
            grid.integrate(coordinates, depth, color, depth_k, color_k, extrinsic, scale, farthest)
            times.append((time.perf_counter() - start) * 1000)
    integrate_cpu_ms = (time.process_time() - cpu_start) * 1000 / len(times)
    integrated_mib = memory_mib("VmHWM:")
    start, cpu_start = time.perf_counter(), time.process_time()
    mesh = grid.extract_triangle_mesh(weight_threshold=3.0)
    extract_ms = (time.perf_counter() - start) * 1000
    extract_cpu_ms = (time.process_time() - cpu_start) * 1000
    peak_mib = memory_mib("VmHWM:")
    print(
        json.dumps(
            {
                "program": f"open3d {o3d.__version__}, blocks of {resolution}^3",
                "voxel_mm": voxel_mm,
                "images": len(times),
                "integrate_cpu_ms": round(integrate_cpu_ms, 2),
                "extract_cpu_ms": round(extract_cpu_ms),
                "integrate_mean_ms": round(float(np.mean(times)), 2),
                "integrate_median_ms": round(float(np.median(times)), 2),
                "first_100_ms": round(float(np.mean(times[:100])), 2),
                "last_100_ms": round(float(np.mean(times[-100:])), 2),
                "extract_ms": round(extract_ms, 1),
                "blocks": int(grid.hashmap().size()),
                "before_mib": before_mib,
                "integrated_mib": integrated_mib,
                "peak_mib": peak_mib,
                "vertices": len(mesh.vertex.positions),
                "triangles": len(mesh.triangle.indices),
            }
        )
    )
    o3d.io.write_triangle_mesh(out, mesh.to_legacy())
    if out_of_weight_1:
        o3d.io.write_triangle_mesh(out_of_weight_1, grid.extract_triangle_mesh(weight_threshold=1.0).to_legacy())


main()
