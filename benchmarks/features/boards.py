#!/usr/bin/env python3
"""Board detection of this crate against OpenCV's on rendered boards with known corners, in one run.

    python3 benchmarks/features/boards.py [IMAGES] [--keep FOLDER]

Rendered: OpenCV's own board image through a pinhole camera with mild radial distortion, 5 x 5 samples a pixel, then
light that falls off, blur, noise and 8 bits, on a cluttered background; a part of the boards is hidden or out of view.
A cell of the table is one marker size at one size of squares, over three dictionaries. Peers: `cv2.aruco.CharucoDetector`
and, on plain checkerboards, `cv2.findChessboardCornersSB`, both as they come.

found: boards of which at least 9 corners (of a checkerboard: all) were reported and at most a tenth of them is false; false
corner: farther than 1 px and 0.08 squares from where it is; false grid: more than a tenth of the corners is false, or any grid
where there is no board. Errors are distances to the truth over all true corners, px; z is error / (sigma sqrt 2) as RMS.
IMAGES is how many are made for a marker size, square and dictionary (6); --keep leaves those of the last cell in a folder.
The script makes a virtual environment beside itself with OpenCV below version 5, or uses the one in `SKCLAM_BENCH_VENV`.
"""

import collections
import csv
import os
import pathlib
import subprocess
import sys
import tempfile

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
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

WIDTH, HEIGHT, FOCAL = 640, 480, 620.0
MIDDLE = np.array([0.5 * WIDTH - 0.5, 0.5 * HEIGHT - 0.5])
FINE = 5  # samples a pixel, each way
TEXTURE = 240  # pixels of the printed square
MARKERS = (0.6, 0.7, 0.8, 0.875, 0.9)
SQUARES = (20, 24, 30, 40, 60)
DICTIONARIES = ("DICT_4X4_50", "DICT_5X5_100", "DICT_6X6_250")
MIN_CORNERS = 9

Layout = collections.namedtuple("Layout", "columns rows dictionary marker legacy")


def peer_board(layout):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, layout.dictionary))
    board = cv2.aruco.CharucoBoard((layout.columns + 1, layout.rows + 1), 1.0, layout.marker, dictionary)
    board.setLegacyPattern(layout.legacy)
    return board


def texture(layout):
    """The print with a white rim of half a square; corner (c, r) is at (c + 1.5) TEXTURE - 0.5."""
    size = (TEXTURE * (layout.columns + 1), TEXTURE * (layout.rows + 1))
    if layout.dictionary:
        image = peer_board(layout).generateImage(size, marginSize=0, borderBits=1)
    else:
        row, column = np.mgrid[0:size[1], 0:size[0]] // TEXTURE
        image = (255 * ((row + column) % 2)).astype(np.uint8)
    return cv2.copyMakeBorder(image, *[TEXTURE // 2] * 4, cv2.BORDER_CONSTANT, value=255)


def clutter(rng):
    """A background of soft blobs, lines and rectangles, some of them regular."""
    image = cv2.resize(rng.uniform(40, 200, (12, 16)).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    for _ in range(25):
        a, b = rng.integers(0, (WIDTH, HEIGHT), (2, 2))
        gray = float(rng.uniform(20, 230))
        if rng.random() < 0.5:
            cv2.rectangle(image, tuple(map(int, a)), tuple(map(int, a + rng.integers(5, 60, 2))), gray, -1)
        else:
            cv2.line(image, tuple(map(int, a)), tuple(map(int, b)), gray, int(rng.integers(1, 6)))
    x, y, step = *rng.integers(0, (WIDTH - 150, HEIGHT - 120)), int(rng.integers(8, 20))
    for k in range(8):  # a row of keys
        for j in range(5):
            corner = (int(x + k * step), int(y + j * step))
            cv2.rectangle(image, corner, (corner[0] + step // 2, corner[1] + step // 2), float(rng.uniform(20, 60)), -1)
    return image


def camera_from_board(layout, square_px, rng, tilt_deg):
    """Homography from squares (corner (0, 0) first) to undistorted pixels."""
    tilt, about, way = np.radians(rng.uniform(*tilt_deg)), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    rotation = cv2.Rodrigues(tilt * np.array([np.cos(way), np.sin(way), 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, about]))[0]
    middle = np.array([0.5 * (layout.columns - 1), 0.5 * (layout.rows - 1), 0.0])
    distance = FOCAL / square_px
    shift = rng.uniform(-0.18, 0.18, 2) * (WIDTH, HEIGHT)
    center = np.array([*(shift / FOCAL * distance), distance])
    camera = np.array([[FOCAL, 0, MIDDLE[0]], [0, FOCAL, MIDDLE[1]], [0, 0, 1.0]])
    return camera @ np.column_stack([rotation[:, 0], rotation[:, 1], center - rotation @ middle])


def ideal(pixels, k1):
    """Undistorted pixels of distorted ones: a polynomial this way, so that rendering is exact."""
    offset = (pixels - MIDDLE) / FOCAL
    return MIDDLE + FOCAL * offset * (1.0 + k1 * (offset**2).sum(-1, keepdims=True))


def distorted(points, k1):
    found = points.copy()
    for _ in range(50):
        found += points - ideal(found, k1)
    return found


def render(layout, square_px, rng, tilt_deg=(0, 50), hide=0.3):
    """An 8 bit image and the places of the corners in it, rows of (column, row, x, y)."""
    h, k1 = camera_from_board(layout, square_px, rng, tilt_deg), rng.uniform(-0.05, 0.15)
    x, y = np.meshgrid(*[(np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (WIDTH, HEIGHT)])
    flat = ideal(np.stack([x, y], -1).reshape(-1, 2), k1)
    board = cv2.perspectiveTransform(flat[None], np.linalg.inv(h))[0].reshape(HEIGHT * FINE, WIDTH * FINE, 2)
    at = ((board + 1.5) * TEXTURE - 0.5).astype(np.float32)
    printed = cv2.remap(texture(layout), at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
    on_board = cv2.resize((printed != 1).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(printed.astype(np.float32) * (printed != 1), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    white, black = rng.uniform(140, 230), rng.uniform(10, 40)
    image = on_board * black + (white - black) * coarse / 255.0 + (1 - on_board) * clutter(rng)
    if rng.random() < hide:
        middle = np.array([WIDTH, HEIGHT]) * rng.uniform(0.3, 0.7, 2)
        reach = square_px * rng.uniform(1.0, 1.8)
        corners = middle + reach * np.array([[np.cos(a), np.sin(a)] for a in np.sort(rng.uniform(0, 2 * np.pi, 7))])
        cv2.fillPoly(image, [corners.astype(np.int32)], float(rng.uniform(30, 200)))
    slope = rng.uniform(-0.35, 0.35)
    image *= 1.0 + slope * (np.arange(WIDTH) / WIDTH - 0.5)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.3))
    image += rng.normal(0.0, rng.uniform(0.5, 4.0), image.shape)
    column, row = np.meshgrid(np.arange(layout.columns), np.arange(layout.rows))
    cells = np.column_stack([column.ravel(), row.ravel()])
    truth = distorted(cv2.perspectiveTransform(cells[None].astype(float), h)[0], k1)
    return np.clip(np.round(image), 0, 255).astype(np.uint8), np.column_stack([cells, truth])


def peer(image, layout):
    """OpenCV's corners: (column, row, x, y)."""
    if layout.dictionary:
        corners, ids, _, _ = cv2.aruco.CharucoDetector(peer_board(layout)).detectBoard(image)
        if ids is None:
            return np.empty((0, 4))
        ids = ids.ravel()
        return np.column_stack([ids % layout.columns, ids // layout.columns, corners.reshape(-1, 2)])
    ok, corners = cv2.findChessboardCornersSB(image, (layout.columns, layout.rows), None, cv2.CALIB_CB_ACCURACY)
    if not ok:
        return np.empty((0, 4))
    ids = np.arange(layout.columns * layout.rows)
    return np.column_stack([ids % layout.columns, ids // layout.columns, corners.reshape(-1, 2)])


def ours(folder, files, layout):
    """For each file the ways to count: lists of rows (column, row, x, y, sigma)."""
    kind = [layout.dictionary, str(layout.marker)] if layout.dictionary else []
    run = subprocess.run([TARGET / "release" / "examples" / "detect_boards", str(layout.columns), str(layout.rows), *kind,
                          "--", *[folder / file for file in files]], check=True, capture_output=True, text=True)
    found = {file: {} for file in files}
    for line in csv.DictReader(run.stdout.splitlines()):
        ways = found[pathlib.Path(line["image"]).name]
        ways.setdefault(int(line["labelling"]), []).append([float(line[k]) for k in ("column", "row", "x_px", "y_px", "sigma_px")])
    return {file: [np.array(way) for way in ways.values()] for file, ways in found.items()}


class Tally:
    """What one detector made of some images."""

    def __init__(self):
        self.boards = self.found = self.false_grids = self.corners = self.false_corners = self.several = 0
        self.errors, self.scores = [], []

    def add(self, ways, truth, square_px, needed):
        self.boards += 1
        if not ways or len(ways[0]) == 0:
            return
        self.several += len(ways) > 1
        places = {(int(c), int(r)): (x, y) for c, r, x, y in truth}
        best = None
        for way in ways:
            errors = np.array([np.hypot(*(row[2:4] - places[int(row[0]), int(row[1])])) for row in way])
            wrong = int((errors > max(1.0, 0.08 * square_px)).sum())
            if best is None or wrong < best[0]:
                best = (wrong, errors, way)
        wrong, errors, way = best
        if wrong > 0.1 * len(errors):
            self.false_grids += 1
            return
        self.found += len(errors) - wrong >= needed
        self.corners += len(errors) - wrong
        self.false_corners += wrong
        right = errors <= max(1.0, 0.08 * square_px)
        self.errors.extend(errors[right])
        if way.shape[1] > 4:
            self.scores.extend(errors[right] / (np.sqrt(2.0) * way[right, 4]))

    def line(self):
        quantiles = np.percentile(self.errors, [50, 95]) if self.errors else [np.nan, np.nan]
        z = f" z {np.sqrt(np.mean(np.square(self.scores))):4.2f}" if self.scores else ""
        return (f"{self.found:3}/{self.boards:3} boards {self.corners:6} corners {self.false_corners:3} false "
                f"{self.false_grids:2} false grids, error {quantiles[0]:.3f} {quantiles[1]:.3f} px{z}")

    def merge(self, other):
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


def compare(folder, layout, shots, square_px, needed):
    """Both detectors on (image, truth) pairs; plain checkerboards may be counted from either end, so all ways of the peer count."""
    mine, theirs = Tally(), Tally()
    files = [f"{k:03}.png" for k in range(len(shots))]
    for file, (image, _) in zip(files, shots):
        cv2.imwrite(str(folder / file), image)
    found = ours(folder, files, layout)
    for file, (image, truth) in zip(files, shots):
        mine.add(found[file], truth, square_px, needed)
        corners = peer(image, layout)
        ways = [corners]
        if not layout.dictionary and len(corners):
            last = np.array([layout.columns - 1, layout.rows - 1])
            ways.append(np.column_stack([last - corners[:, :2], corners[:, 2:]]))
        theirs.add(ways, truth, square_px, needed)
    return mine, theirs


def report(title, pairs):
    both = Tally(), Tally()
    for name, mine, theirs in pairs:
        print(f"{title} {name}\n   ours   {mine.line()}\n   opencv {theirs.line()}", flush=True)
        both[0].merge(mine)
        both[1].merge(theirs)
    print(f"{title} ALL\n   ours   {both[0].line()}, {both[0].several} with several ways to count\n   opencv {both[1].line()}\n", flush=True)


def charuco(folder, count):
    for marker in MARKERS:
        for square_px in SQUARES:
            mine, theirs = Tally(), Tally()
            for k, dictionary in enumerate(DICTIONARIES):
                rng = np.random.default_rng([int(1000 * marker), square_px, k])
                layout = Layout(7, 5, dictionary, marker, False)
                shots = [render(layout, square_px, rng) for _ in range(count)]
                for tally, more in zip((mine, theirs), compare(folder, layout, shots, square_px, MIN_CORNERS)):
                    tally.merge(more)
            yield f"marker {marker} square {square_px} px", mine, theirs


def others(folder, count):
    rng = np.random.default_rng(5)
    legacy = Layout(6, 5, "DICT_5X5_100", 0.875, True)
    yield "legacy pattern, 7 x 6 squares", *compare(folder, legacy, [render(legacy, 36, rng) for _ in range(3 * count)], 36, MIN_CORNERS)
    for square_px in (16, 24, 40):
        plain = Layout(11, 8, None, None, False)
        shots = [render(plain, square_px, rng, hide=0.0) for _ in range(3 * count)]
        whole = [s for s in shots if (s[1][:, 2:] > 8).all() and (s[1][:, 2:] < (WIDTH - 9, HEIGHT - 9)).all()]
        yield f"checkerboard 11 x 8, {square_px} px", *compare(folder, plain, whole, square_px, 88)


def nothing(folder, count):
    """Images without the board: clutter, and boards with other markers. (Of a checkerboard any smaller one may be a part.)"""
    nowhere = np.array([[c, r, -1e6, -1e6] for c in range(16) for r in range(16)], float)
    rng = np.random.default_rng(9)
    board, plain = Layout(7, 5, "DICT_4X4_50", 0.875, False), Layout(11, 8, None, None, False)

    def cluttered():
        return np.clip(clutter(rng) + rng.normal(0, 2, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)

    def another():
        return render(board._replace(dictionary="DICT_6X6_250"), 36, rng)[0]

    for name, layout, make in (("charuco: clutter", board, cluttered), ("charuco: other markers", board, another),
                               ("checkerboard: clutter", plain, cluttered)):
        yield name, *compare(folder, layout, [(make(), nowhere) for _ in range(4 * count)], 36, MIN_CORNERS)


def main():
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of narrow margins for each board
    subprocess.run(["cargo", "build", "--release", "-q", "-p", "skclam-features", "--example", "detect_boards"], cwd=ROOT, check=True)
    count = int(sys.argv[1]) if sys.argv[1:] and sys.argv[1].isdigit() else 6
    print(f"OpenCV {cv2.__version__}, numpy {np.__version__}, {count} images a marker size, square and dictionary\n")
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(sys.argv[sys.argv.index("--keep") + 1] if "--keep" in sys.argv else temporary)
        folder.mkdir(exist_ok=True)
        report("charuco", charuco(folder, count))
        report("other", others(folder, count))
        report("no board", nothing(folder, count))


if __name__ == "__main__":
    main()
