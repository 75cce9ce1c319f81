#!/usr/bin/env python3
"""AKAZE of this crate against OpenCV's, in one run on the same images.

    python3 benchmarks/features/akaze_vs_opencv.py [speed] [memory] [turn] [localization] [matches] [instructions]

Without arguments everything is run. The script makes a virtual environment in `benchmarks/.venv` with OpenCV below version 5
(which has no AKAZE any more) and numpy, builds the worker (`cargo build --release -p skclam-features --example
akaze_worker`) and starts it as a process of its own. Data: `../shared/data`, or the folder in `SKCLAM_DATA`.
Definitions of what is printed are in README.md.
"""

import collections
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
DATA = pathlib.Path(os.environ.get("SKCLAM_DATA", ROOT.parent / "shared" / "data"))
ENVIRONMENT = pathlib.Path(os.environ.get("SKCLAM_BENCH_VENV", HERE.parent / ".venv"))
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

SCRATCH = pathlib.Path(tempfile.mkdtemp(prefix="akaze-benchmark-"))
RECORD = np.dtype([("keypoint", "<f4", 6), ("descriptor", "u1", 64)])


class Ours:
    """The worker process."""

    PATH = TARGET / "release" / "examples" / "akaze_worker"

    def __init__(self):
        self.process = subprocess.Popen([self.PATH], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, command):
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()

    def set(self, threshold, threads=None):
        self.ask('options {"threshold": %.9g}' % threshold)
        if threads:
            self.ask(f"threads {threads}")

    def features(self, path):
        """Positions, descriptors, responses, angles in radians."""
        self.ask(f"save {path} {SCRATCH / 'features.bin'}")
        a = np.fromfile(SCRATCH / "features.bin", RECORD)
        k = a["keypoint"]
        return k[:, :2].astype(float), np.ascontiguousarray(a["descriptor"]), k[:, 4], k[:, 3]


class OpenCV:
    """The peer, with the same functions."""

    def set(self, threshold, threads=None):
        self.akaze = cv2.AKAZE_create(threshold=threshold)
        if threads:
            cv2.setNumThreads(threads)

    def features(self, path):
        keypoints, descriptors = self.akaze.detectAndCompute(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), None)
        positions = np.array([k.pt for k in keypoints], float).reshape(-1, 2)
        if descriptors is None:
            descriptors = np.zeros((0, 61), np.uint8)
        angles = np.radians([k.angle for k in keypoints])
        return positions, descriptors, np.array([k.response for k in keypoints]), angles


def strongest(features, count):
    order = np.argsort(-features[2], kind="stable")[:count]
    return tuple(f[order] for f in features)


def match(a, b, ratio=0.8):
    """Index pairs: nearest in Hamming distance, ratio test, cross-check. The same matcher for both."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), int)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(b, a, k=1)}
    pairs = [(m.queryIdx, m.trainIdx) for m, n in matcher.knnMatch(a, b, k=2)
             if m.distance < ratio * n.distance and back[m.trainIdx] == m.queryIdx]
    return np.array(pairs, int).reshape(-1, 2)


def offsets(homography, a, b, pairs):
    """Of each pair, where b lies relative to a mapped into b's image, in pixels."""
    p = np.c_[a[0][pairs[:, 0]], np.ones(len(pairs))] @ homography.T
    return b[0][pairs[:, 1]] - p[:, :2] / p[:, 2:]


def grey(*parts):
    image = cv2.imread(str(DATA.joinpath(*parts)), cv2.IMREAD_GRAYSCALE)
    if image is None:
        sys.exit(f"cannot read {DATA.joinpath(*parts)}; set SKCLAM_DATA")
    return image


def natural_images():
    return {
        "boat": grey("homographies", "boat", "img1.pgm"),
        "iguazu": grey("homographies", "iguazu", "img1.pgm"),
        "virtual-cell": grey("virtual-cell", "color", "000.jpg"),
        "apc-shelf": grey("apc-shelf", "color", "000.png"),
        "wheel-d405": first_of("wheel-d405"),
        "nachi": grey("nachi-mz25", "color", "000.jpg")[400:1200, 500:1600],
    }


def first_of(dataset):
    return grey(dataset, "color", sorted(os.listdir(DATA / dataset / "color"))[0])


def speed_image():
    """A real picture of 1920x1080 on which the default threshold gives about 8,000 keypoints."""
    path = SCRATCH / "speed.png"
    cv2.imwrite(str(path), cv2.resize(grey("virtual-cell", "color", "000.jpg"), (1920, 1080),
                                      interpolation=cv2.INTER_CUBIC))
    return path


def speed(rounds=31):
    print("## Time: detect and describe, 1920x1080, alternately, median of pairs")
    path, ours, peer = speed_image(), Ours(), OpenCV()
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    threshold = 0.001
    for threads in (1, 2):
        ours.set(threshold, threads)
        peer.set(threshold, threads)
        times = []
        for i in range(rounds + 2):
            begin = time.perf_counter()
            keypoints, _ = peer.akaze.detectAndCompute(image, None)
            theirs = time.perf_counter() - begin
            nanoseconds, count = ours.ask(f"run {path}").split()
            if i >= 2:
                times.append((int(nanoseconds) * 1e-9, theirs))
        t = np.array(times)
        q = np.percentile(t[:, 0] / t[:, 1], [50, 10, 90])
        print(f"{threads} thread(s): ours {1e3 * np.median(t[:, 0]):.1f} ms, OpenCV {1e3 * np.median(t[:, 1]):.1f} ms, "
              f"ratio {q[0]:.3f} (10 % {q[1]:.3f}, 90 % {q[2]:.3f}); "
              f"keypoints ours {count}, OpenCV {len(keypoints)}, ratio {int(count) / len(keypoints):.3f}")


PEER_MEMORY = """
import sys, cv2
def peak():
    return [int(l.split()[1]) for l in open('/proc/self/status') if l.startswith('VmHWM')][0]
image = cv2.imread(sys.argv[1], cv2.IMREAD_GRAYSCALE)
cv2.setNumThreads(int(sys.argv[2]))
begin = peak()
for _ in range(3):
    cv2.AKAZE_create().detectAndCompute(image, None)
print(begin, peak())
"""


def memory():
    print("## Peak resident memory, 1920x1080, three runs in a fresh process")
    path = speed_image()
    for threads in (1, 2):
        ours = Ours()
        ours.set(0.001, threads)
        small = SCRATCH / "tiny.png"
        cv2.imwrite(str(small), np.zeros((8, 8), np.uint8))
        ours.ask(f"run {small}")
        before = int(ours.ask("memory"))
        for _ in range(3):
            ours.ask(f"run {path}")
        after = int(ours.ask("memory"))
        out = subprocess.run([sys.executable, "-c", PEER_MEMORY, str(path), str(threads)], check=True,
                             capture_output=True, text=True).stdout
        peer_before, peer_after = map(int, out.split())
        print(f"{threads} thread(s): whole process ours {after / 1024:.0f} MB, OpenCV {peer_after / 1024:.0f} MB, "
              f"ratio {after / peer_after:.3f}; growth by the runs ours {(after - before) / 1024:.0f} MB, "
              f"OpenCV {(peer_after - peer_before) / 1024:.0f} MB, "
              f"ratio {(after - before) / (peer_after - peer_before):.3f}")


def turn():
    print("## A turn by 180 degrees: mean offset of correct matches (exact, no resampling)")
    for name, implementation in (("ours", Ours()), ("OpenCV", OpenCV())):
        implementation.set(0.001, 2)
        shifts = []
        for image in natural_images().values():
            a, b = SCRATCH / "a.png", SCRATCH / "b.png"
            cv2.imwrite(str(a), image)
            cv2.imwrite(str(b), image[::-1, ::-1])
            h, w = image.shape
            homography = np.array([[-1.0, 0, w - 1], [0, -1, h - 1], [0, 0, 1]])
            fa, fb = implementation.features(a), implementation.features(b)
            d = offsets(homography, fa, fb, match(fa[1], fb[1]))
            shifts.append(d[np.linalg.norm(d, axis=1) < 3])
        d = np.concatenate(shifts)
        print(f"{name}: x {d[:, 0].mean():+.5f} px, y {d[:, 1].mean():+.5f} px, over {len(d)} matches; "
              f"median length {np.median(np.linalg.norm(d, axis=1)):.5f} px")


def groups():
    def rotation(degrees):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

    def viewpoint(degrees):
        # A plane at distance 1.2 image widths, the camera turned about its vertical axis.
        def make(w, h):
            f = 1.2 * w
            k = np.diag([f, f, 1.0])
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            turned = np.array([[c, 0, 0], [0, 1, 0], [-s, 0, 1.0]])
            return k @ turned @ np.linalg.inv(k)
        return make

    return {
        "rotation": {f"{d} deg": (lambda w, h, d=d: rotation(d)) for d in (10, 30, 45, 60, 90, 120, 150, 180)},
        "zoom": {f"{z}": (lambda w, h, z=z: np.diag([z, z, 1.0])) for z in (0.7, 0.8, 0.9, 1.1, 1.25, 1.4)},
        "viewpoint": {f"{d} deg": viewpoint(d) for d in (10, 20, 30, 40)},
    }


def warp(image, centred):
    """The image under a homography about its centre, on a canvas that holds it; and the homography in pixels."""
    h, w = image.shape
    to_centre = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, 1.0]])
    corners = centred @ to_centre @ np.array([[0, w - 1, w - 1, 0], [0, 0, h - 1, h - 1], [1, 1, 1, 1.0]])
    corners = corners[:2] / corners[2]
    low, size = corners.min(axis=1), np.ptp(corners, axis=1)
    columns, rows = (int(np.ceil(s)) + 1 for s in size)
    homography = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1.0]]) @ centred @ to_centre
    # Anti-aliasing where the image shrinks: twice the resolution is warped, smoothed and halved exactly.
    double = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]]) @ homography
    fine = cv2.warpPerspective(image, double, (2 * columns, 2 * rows), flags=cv2.INTER_CUBIC,
                               borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA), homography


def localization():
    print("## Median error in pixels of correct matches (within 3 px, ratio 0.8, cross-check), all natural images")
    implementations = {"ours": Ours(), "OpenCV": OpenCV()}
    for i in implementations.values():
        i.set(0.001, 2)
    images = natural_images()
    first = {}
    for image_name, image in images.items():
        path = SCRATCH / f"{image_name}.png"
        cv2.imwrite(str(path), image)
        for name, i in implementations.items():
            first[image_name, name] = i.features(path)
    print("group | ours px | OpenCV px | ratio | correct ours | correct OpenCV | ratio | precision ours | OpenCV")
    for group, members in groups().items():
        pooled = {name: [] for name in implementations}
        total = {name: 0 for name in implementations}
        for member, make in members.items():
            of_member = {name: [] for name in implementations}
            for image_name, image in images.items():
                warped, homography = warp(image, make(image.shape[1], image.shape[0]))
                path = SCRATCH / "warped.png"
                cv2.imwrite(str(path), warped)
                second = {name: i.features(path) for name, i in implementations.items()}
                counts = [min(len(first[image_name, n][0]) for n in implementations),
                          min(len(second[n][0]) for n in implementations)]
                for name in implementations:
                    a = strongest(first[image_name, name], counts[0])
                    b = strongest(second[name], counts[1])
                    pairs = match(a[1], b[1])
                    e = np.linalg.norm(offsets(homography, a, b, pairs), axis=1)
                    of_member[name].append(e[e < 3])
                    total[name] += len(pairs)
            for name in implementations:
                of_member[name] = np.concatenate(of_member[name])
                pooled[name].append(of_member[name])
            line(f"{group} {member}", of_member["ours"], of_member["OpenCV"])
        ours, peer = (np.concatenate(pooled[n]) for n in ("ours", "OpenCV"))
        line(f"**{group}**", ours, peer, [len(ours) / total["ours"], len(peer) / total["OpenCV"]])


def line(name, ours, peer, precision=()):
    print(f"{name} | {np.median(ours):.4f} | {np.median(peer):.4f} | {np.median(ours) / np.median(peer):.3f} | "
          f"{len(ours)} | {len(peer)} | {len(ours) / len(peer):.3f}" + "".join(f" | {p:.3f}" for p in precision))


def matches():
    print("## Correct matches on the real pairs (within 3 px, ratio 0.8, cross-check), equal numbers of keypoints")
    ours, peer = Ours(), OpenCV()
    ours.set(0.001, 2)
    peer.set(0.001, 2)
    sums = np.zeros(2, int)
    worst = 9.0
    for scene in ("boat", "iguazu"):
        folder = DATA / "homographies" / scene
        a = [i.features(folder / "img1.pgm") for i in (ours, peer)]
        for k in range(2, 7):
            homography = np.loadtxt(folder / f"H1to{k}p")
            b = [i.features(folder / f"img{k}.pgm") for i in (ours, peer)]
            counts = [min(len(f[0]) for f in features) for features in (a, b)]
            correct, text = [], []
            for fa, fb in zip(a, b):
                fa, fb = strongest(fa, counts[0]), strongest(fb, counts[1])
                pairs = match(fa[1], fb[1])
                e = np.linalg.norm(offsets(homography, fa, fb, pairs), axis=1)
                correct.append(int((e < 3).sum()))
                text.append(f"{correct[-1]}/{len(pairs)} ({np.median(e[e < 3]):.3f} px)")
            sums += correct
            worst = min(worst, correct[0] / correct[1])
            print(f"{scene} 1-{k}: keypoints {counts[0]}, {counts[1]}; ours {text[0]}, OpenCV {text[1]}, "
                  f"ratio {correct[0] / correct[1]:.3f}")
    print(f"sum: ours {sums[0]}, OpenCV {sums[1]}, ratio {sums[0] / sums[1]:.3f}; worst pair {worst:.3f}")


def instructions():
    print("## Instructions of one run on 1 thread with fresh buffers (callgrind), 1920x1080, in millions")
    if not shutil.which("valgrind"):
        print("skipped: valgrind is not installed")
        return
    out = SCRATCH / "callgrind.out"
    subprocess.run(["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}", Ours.PATH], check=True, text=True,
                   input=f"threads 1\nrun {speed_image()}\n", capture_output=True)
    text = subprocess.run(["callgrind_annotate", "--threshold=100", out], check=True, text=True,
                          capture_output=True).stdout
    # Lines are "count (share) file:function [object]"; code inlined from elsewhere is added to its function.
    sums = collections.Counter()
    for count, function in re.findall(r"^ *([\d,]+) \(.*?\) +\S*?:(.*)$", text, re.MULTILINE):
        found = re.search(r"skclam_features::akaze::(\w+)::(\w+)", function)
        if found:
            sums["::".join(found.groups())] += int(count.replace(",", ""))
    for function, count in sums.max_common():
        if count > 1e6:
            print(f"{function:32} {count / 1e6:8.1f}")
    print(f"{'sum of named functions':32} {sum(sums.values()) / 1e6:8.1f}")


def main():
    subprocess.run(["cargo", "build", "--release", "-q", "-p", "skclam-features", "--example", "akaze_worker"],
                   check=True, cwd=ROOT)
    parts = {f.__name__: f for f in (speed, memory, turn, localization, matches, instructions)}
    print(f"OpenCV {cv2.__version__}, {os.cpu_count()} processors")
    for name in sys.argv[1:] or parts:
        parts[name]()
        print(flush=True)


if __name__ == "__main__":
    main()
