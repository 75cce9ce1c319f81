"""One least-squares problem, three solvers, one run: 1e5 Sampson distances, the paper's ten angles.

    apt-get install g++ libceres-dev
    python3 -m venv VENV && VENV/bin/pip install numpy scipy
    VENV/bin/python benchmarks/estimator/compare_solvers.py [THREADS]

The example `timing` makes the problem, writes it and solves it; Ceres has it in C++ (`ceres_sampson.cpp`, compiled here), SciPy has the residuals vectorised with
NumPy and differences for the ten columns, as a user would write it. All start from the nominal arm and may use as many threads (1 unless told). The best of several
repetitions counts; processor time of all threads decides, which a busy machine disturbs less than the clock on the wall.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

threads = sys.argv[1] if len(sys.argv) > 1 else "1"
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[variable] = threads

here = Path(__file__).resolve().parent
folder = tempfile.TemporaryDirectory()
prefix = str(Path(folder.name) / "problem")


def told(command, **environment):
    """The lines of a command that tell a solver's time: `cpu_ms=... wall_ms=... solver=...`."""
    done = subprocess.run(command, cwd=here, env=os.environ | environment, check=True, capture_output=True, text=True)
    pattern = r"cpu_ms=([\d.]+) wall_ms=([\d.]+) solver=(.*)"
    return [(float(cpu), float(wall), text) for cpu, wall, text in re.findall(pattern, done.stdout)]


timing = "cargo run --release -q -p skclam-calibration --example timing pairwise".split()
(ours,) = told(timing, SKCLAM_DUMP=prefix)
program = str(Path(folder.name) / "ceres_sampson")
compiler = "g++ -O3 -march=native -std=c++17 -I /usr/include/eigen3 ceres_sampson.cpp -lceres -lglog -o".split()
subprocess.run([*compiler, program], cwd=here, check=True)
ceres = told([program, prefix, threads]) + told([program, prefix, threads, "--jets"])

# After the environment, which NumPy reads once.
import time

import numpy as np
import scipy
from scipy.optimize import least_squares

matches = np.loadtxt(prefix + "-matches.csv", delimiter=",", skiprows=1)
joints = np.loadtxt(prefix + "-joints.csv", delimiter=",")
rows = [line.split(",") for line in open(prefix + "-angles.csv")]
nominal = np.array([float(row[1]) for row in rows])
truth = np.array([float(row[2]) for row in rows])

A = [0.0, 0.1, 0.29, 0.085, 0.0, 0.0]
D = [0.29, 0.0, 0.0, 0.3, 0.0, 0.09]
FOCAL = 0.5 * 1920 / np.tan(np.radians(35.0))
K_INVERSE = np.linalg.inv(np.array([[FOCAL, 0, 959.5], [0, FOCAL, 539.5], [0, 0, 1.0]]))
MOUNT = np.eye(4)
MOUNT[:3, :3] = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
MOUNT[:3, 3] = [-0.06, 0.0, 0.04]

pair_of = matches[:, :2].astype(int)
_, pair_index = np.unique(pair_of[:, 0], return_inverse=True)
pairs = np.unique(pair_of, axis=0)
ones = np.ones(len(matches))
in_a = np.column_stack([matches[:, 2:4], ones])
in_b = np.column_stack([matches[:, 4:6], ones])


def poses(angles):
    alpha = np.concatenate([[0.0], angles[0::2]])
    offset = np.concatenate([[0.0], angles[1::2]])
    pose = np.tile(np.eye(4), (len(joints), 1, 1))
    for i in range(6):
        ca, sa = np.cos(alpha[i]), np.sin(alpha[i])
        c, s = np.cos(joints[:, i] + offset[i]), np.sin(joints[:, i] + offset[i])
        link = np.zeros_like(pose)
        link[:, 0, 0], link[:, 0, 1], link[:, 0, 3] = c, -s, A[i]
        link[:, 1, 0], link[:, 1, 1], link[:, 1, 2], link[:, 1, 3] = ca * s, ca * c, -sa, -sa * D[i]
        link[:, 2, 0], link[:, 2, 1], link[:, 2, 2], link[:, 2, 3] = sa * s, sa * c, ca, ca * D[i]
        link[:, 3, 3] = 1.0
        pose = pose @ link
    return pose @ MOUNT


def residuals(angles):
    base_from_camera = poses(angles)
    relative = np.linalg.inv(base_from_camera[pairs[:, 0]]) @ base_from_camera[pairs[:, 1]]
    t = relative[:, :3, 3]
    hat = np.zeros((len(pairs), 3, 3))
    hat[:, 0, 1], hat[:, 0, 2], hat[:, 1, 2] = -t[:, 2], t[:, 1], -t[:, 0]
    hat -= hat.transpose(0, 2, 1)
    fundamental = K_INVERSE.T @ hat @ relative[:, :3, :3] @ K_INVERSE
    of_match = fundamental[pair_index]
    line_a = np.einsum("nij,nj->ni", of_match, in_b)
    line_b = np.einsum("nji,nj->ni", of_match, in_a)
    scale = np.sqrt((line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1))
    return (line_a * in_a).sum(1) / scale


best, best_cpu, result = np.inf, np.inf, None
for _ in range(3):
    start, cpu = time.perf_counter(), time.process_time()
    result = least_squares(residuals, nominal, method="lm", xtol=1e-12, ftol=1e-12)
    best_cpu = min(best_cpu, time.process_time() - cpu)
    best = min(best, time.perf_counter() - start)
error = np.degrees(np.abs(result.x - truth)).max()
text = (
    f"SciPy {scipy.__version__} least_squares (lm, differences, threads {threads}): {result.nfev} calls, theta_offset_6 {result.x[9]:.9f} rad, "
    f"largest error {error:.5f} deg, rms {np.sqrt(2 * result.cost / len(matches)):.4f} px"
)
for cpu, wall, text in [ours, *ceres, (best_cpu * 1e3, best * 1e3, text)]:
    print(f"{cpu:9.2f} ms of CPU, {wall:9.2f} ms on the wall, ours / this {ours[0] / cpu:6.4f}: {text}")
print(f"{len(matches)} residuals; at most 0.05 of SciPy's and 0.5 of Ceres's time are asked")
