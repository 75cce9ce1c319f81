#!/usr/bin/env python3
"""Matching of this crate against OpenCV's BFMatcher, guided against exhaustive matching, and refinement.

    python3 benchmarks/features/matching.py

8,000 x 8,000 random descriptors of 486 bits. OpenCV: `knnMatch(k=2)` from A to B and from B to A, which is what the
ratio test and the cross-check need; the loops in Python that would apply them are not counted. Ours: both directions,
ratio test and cross-check. Runs alternate; printed is the median of each and of the ratios of neighbouring runs, against
OpenCV by wall clock, guided against exhaustive by processor time. Then the instructions of each kind (callgrind, if
valgrind is there; it knows no AVX-512, so these are the AVX2 kernels), the refinement under homographies, and the Sampson
distances at the true poses of `virtual-cell` before and after refinement by the pipeline's own stages. The script makes a virtual environment beside itself with OpenCV below version 5, or uses the one in
`SKCLAM_BENCH_VENV`. Data for the refinement: `../shared/data`, or the folder in `SKCLAM_DATA`.
"""

import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
DATA = pathlib.Path(os.environ.get("SKCLAM_DATA", ROOT.parent / "shared" / "data"))
ENVIRONMENT = pathlib.Path(os.environ.get("SKCLAM_BENCH_VENV", HERE / ".venv"))
TARGET = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))

try:
    import cv2
    import numpy as np
except ImportError:
    python = ENVIRONMENT / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(ENVIRONMENT)], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", "opencv-python-headless<5", "numpy"], check=True)
    os.execv(python, [str(python), *sys.argv])

COUNT = 8000
ROUNDS = 7


def ours(folder, threads):
    """Milliseconds by kind: by wall clock, and of the processor; medians."""
    run = subprocess.run([TARGET / "release" / "examples" / "matching_benchmark", folder / "a", folder / "b", "3"],
                         env={**os.environ, "RAYON_NUM_THREADS": str(threads)}, check=True, capture_output=True, text=True)
    times = {}
    for line in run.stdout.splitlines():
        kind, wall, _, processor = line.split()[:4]
        times.setdefault(kind, []).append((float(wall), float(processor)))
    return {kind: tuple(map(statistics.median, zip(*values))) for kind, values in times.items()}


def instructions(folder, kind):
    """Instructions of one run of one kind on one thread, start of the program included."""
    run = subprocess.run(["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null",
                          TARGET / "release" / "examples" / "matching_benchmark", folder / "a", folder / "b", "1", kind],
                         env={**os.environ, "RAYON_NUM_THREADS": "1"}, check=True, capture_output=True, text=True)
    return int(next(line for line in run.stderr.splitlines() if "Collected" in line).split(":")[-1])


def main():
    for package, example in (("skclam-features", "matching_benchmark"), ("skclam-features", "refinement_benchmark"),
                             ("skclam", "sampson_at_truth")):
        subprocess.run(["cargo", "build", "--release", "-q", "-p", package, "--example", example], cwd=ROOT, check=True)
    folder = pathlib.Path(tempfile.mkdtemp(prefix="matching-benchmark-"))
    random = np.random.default_rng(1)
    descriptors = []
    for name in "ab":
        bits = random.integers(0, 2, (COUNT, 512), dtype=np.uint8)
        bits[:, 486:] = 0
        descriptors.append(np.packbits(bits, axis=1, bitorder="little"))
        descriptors[-1].tofile(folder / name)
    a, b = (np.ascontiguousarray(d[:, :61]) for d in descriptors)
    print(f"OpenCV {cv2.__version__}, {COUNT} x {COUNT} descriptors, load {os.getloadavg()[0]:.1f}")
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        peer, mine = [], []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            matcher.knnMatch(a, b, 2)
            matcher.knnMatch(b, a, 2)
            peer.append((time.perf_counter() - start) * 1e3)
            mine.append(ours(folder, threads))
        exhaustive = [times["exhaustive"][0] for times in mine]
        ratio = statistics.median(m / p for m, p in zip(exhaustive, peer))
        print(f"{threads} thread(s): BFMatcher both directions {statistics.median(peer):.1f} ms, "
              f"ours {statistics.median(exhaustive):.1f} ms, ours / BFMatcher's {ratio:.3f}")
        for kind in mine[0]:
            processor = statistics.median(times[kind][1] for times in mine)
            line = f"  {kind}: {processor:.2f} ms of the processor"
            if kind not in ("exhaustive", "refinement"):
                ratio = statistics.median(times[kind][1] / times["exhaustive"][1] for times in mine)
                line += f", guided / exhaustive {ratio:.3f}"
            print(line)
        sys.stdout.flush()
    if shutil.which("valgrind"):
        start = instructions(folder, "none")
        for kind in mine[0]:
            print(f"instructions, {kind}: {(instructions(folder, kind) - start) / 1e6:.2f} million", flush=True)
    subprocess.run([TARGET / "release" / "examples" / "sampson_at_truth", str(DATA / "virtual-cell")], check=True)
    subprocess.run([TARGET / "release" / "examples" / "refinement_benchmark", str(DATA)], check=True)


if __name__ == "__main__":
    main()
