#!/usr/bin/env python3
"""Writes recordings with independent libraries (rosbags, mcap), for the tests and for the import benchmark.

    python3 -m venv venv && venv/bin/pip install rosbags mcap numpy pillow
    venv/bin/python benchmarks/recordings/write_recordings.py matrix OUT [MESSAGES]
    venv/bin/python benchmarks/recordings/write_recordings.py large OUT.mcap [GIGABYTES]

`matrix` writes every container, compression and encoding that the importer reads, MESSAGES colour images each, and
`expected.json` with what is in them (joints, CRC-32 of the pixels). The arm stands, moves, stands, ...
"""

import io
import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
NAMES = ["joint_3", "gripper", "joint_1", "joint_2", "joint_6", "joint_5", "joint_4"]
WIDTH, HEIGHT = 32, 24
START = 1_700_000_000_000_000_000
STEP = 20_000_000  # 50 Hz
ENCODINGS = ["mono8", "rgb8", "bgr8", "rgba8", "bgra8", "png", "jpeg"]
DEPTHS = ["16UC1", "mono16", "32FC1", "compressedDepth", "compressedDepth32"]


def joints(step):
    """25 steps at rest, 25 in motion."""
    cycle, phase = divmod(step, 50)
    share = cycle + min(max(phase - 25, 0) / 25.0, 1.0)
    return {f"joint_{k}": 0.1 * k * share + 0.01 * k for k in range(1, 7)} | {"gripper": 0.02}


def pixels(step):
    generator = np.random.default_rng(step)
    return generator.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_counts(step):
    generator = np.random.default_rng(10_000_000 + step)
    counts = generator.integers(400, 8000, (HEIGHT, WIDTH), dtype=np.uint16)
    counts[0, :4] = 0
    return counts


class Messages:
    """Messages of one ROS version."""

    def __init__(self, store, ros1):
        self.store, self.ros1, self.types = store, ros1, store.types

    def header(self, stamp, frame):
        time = self.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra)

    def joint_state(self, stamp, step):
        values = joints(step)
        return self.types["sensor_msgs/msg/JointState"](
            header=self.header(stamp, ""), name=NAMES, position=np.array([values[name] for name in NAMES]),
            velocity=np.array([]), effort=np.array([]))

    def raw(self, stamp, frame, encoding, data, step):
        return self.types["sensor_msgs/msg/Image"](
            header=self.header(stamp, frame), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0,
            step=step, data=np.frombuffer(data, np.uint8))

    def compressed(self, stamp, frame, form, data):
        return self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(stamp, frame), format=form, data=np.frombuffer(data, np.uint8))

    def color(self, stamp, encoding, step):
        rgb = pixels(step)
        if encoding in ("png", "jpeg"):
            file = io.BytesIO()
            Pillow.fromarray(rgb).save(file, "PNG" if encoding == "png" else "JPEG", quality=95)
            form = f"rgb8; {encoding} compressed bgr8"
            return self.compressed(stamp, "color", form, file.getvalue()), file.getvalue()
        alpha = np.full((HEIGHT, WIDTH, 1), 200, np.uint8)
        layout = {
            "mono8": rgb[:, :, :1], "rgb8": rgb, "bgr8": rgb[:, :, ::-1],
            "rgba8": np.concatenate([rgb, alpha], 2), "bgra8": np.concatenate([rgb[:, :, ::-1], alpha], 2)}[encoding]
        # Rows with some bytes of padding.
        row = WIDTH * layout.shape[2]
        padded = np.zeros((HEIGHT, row + 5), np.uint8)
        padded[:, :row] = layout.reshape(HEIGHT, row)
        return self.raw(stamp, "color", encoding, padded.tobytes(), row + 5), None

    def depth(self, stamp, encoding, step):
        counts = depth_counts(step)
        if encoding in ("16UC1", "mono16"):
            return self.raw(stamp, "color", encoding, counts.tobytes(), 2 * WIDTH)
        if encoding == "32FC1":
            metres = counts.astype(np.float32) * np.float32(1e-3)
            metres[counts == 0] = np.nan
            return self.raw(stamp, "color", encoding, metres.tobytes(), 4 * WIDTH)
        file = io.BytesIO()
        if encoding == "compressedDepth":
            Pillow.fromarray(counts).save(file, "PNG")
            return self.compressed(stamp, "color", "16UC1; compressedDepth png", struct.pack("<iff", 0, 0, 0) + file.getvalue())
        # The inverse depth of image_transport: a / depth + b.
        a, b = 2000.0, 10.0
        metres = np.where(counts > 0, counts * 1e-3, np.inf)
        inverse = np.where(counts > 0, np.round(a / metres + b), 0).astype(np.uint16)
        Pillow.fromarray(inverse).save(file, "PNG")
        return self.compressed(stamp, "color", "32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + file.getvalue())

    def info(self, stamp):
        k = np.array([40.0, 0, 15.5, 0, 41.0, 11.5, 0, 0, 1])
        fields = {"height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        arrays = {"d": np.array([0.1, -0.2, 0.001, 0.002, 0.05]), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        if self.ros1:
            arrays = {name.upper(): value for name, value in arrays.items()}
        return self.types["sensor_msgs/msg/CameraInfo"](header=self.header(stamp, "color"), roi=roi, **fields, **arrays)

    def serialize(self, message, kind):
        return self.store.serialize_ros1(message, kind) if self.ros1 else self.store.serialize_cdr(message, kind)


def fill(add, messages, encoding, depth_encoding, count):
    """Joints at 50 Hz in another order than the arm's, an image and a depth image 3 ms later; returns what is inside."""
    color_type = "sensor_msgs/msg/CompressedImage" if encoding in ("png", "jpeg") else "sensor_msgs/msg/Image"
    depth_type = "sensor_msgs/msg/CompressedImage" if "compressed" in depth_encoding else "sensor_msgs/msg/Image"
    expected = []
    for step in range(count):
        stamp = START + step * STEP
        add("/joint_states", "sensor_msgs/msg/JointState", messages.joint_state(stamp, step), stamp)
        add("/camera/camera_info", "sensor_msgs/msg/CameraInfo", messages.info(stamp), stamp)
        image, file = messages.color(stamp + 1000, encoding, step)
        add("/camera/image_raw", color_type, image, stamp + 2000)
        add("/camera/depth", depth_type, messages.depth(stamp + 3_000_000, depth_encoding, step), stamp + 3_001_000)
        rgb = pixels(step)[:, :, 0] if encoding == "mono8" else pixels(step)
        expected.append({
            "stamp": stamp + 1000,
            "joints": [joints(step)[f"joint_{k}"] for k in range(1, 7)],
            # Of a JPEG the file's bytes, which are to stay as they are.
            "color_crc": zlib.crc32(file if encoding == "jpeg" else np.ascontiguousarray(rgb).tobytes()),
            "depth": [int(value) for value in depth_counts(step).ravel()[:40]],
        })
    return expected


def ros1(path, compression, encoding, depth, count):
    messages = Messages(ROS1, True)
    writer = Writer1(path)
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    with writer:
        connections = {}

        def add(topic, kind, message, time):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], time, messages.serialize(message, kind))

        return fill(add, messages, encoding, depth, count)


def ros2(path, storage, compression, encoding, depth, count):
    messages = Messages(ROS2, False)
    writer = Writer2(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}

        def add(topic, kind, message, time):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], time, messages.serialize(message, kind))

        return fill(add, messages, encoding, depth, count)


def mcap(path, compression, encoding, depth, count):
    """With the mcap package itself, for its compressions and chunks."""
    from mcap.writer import CompressionType
    from mcap.writer import Writer

    messages = Messages(ROS2, False)
    with open(path, "wb") as file:
        writer = Writer(file, compression=getattr(CompressionType, compression), chunk_size=200_000)
        writer.start(profile="ros2", library="write_recordings")
        channels = {}

        def add(topic, kind, message, time):
            if topic not in channels:
                schema = writer.register_schema(name=kind, encoding="ros2msg", data=b"")
                channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
            data = bytes(messages.serialize(message, kind))
            writer.add_message(channels[topic], log_time=time, publish_time=time, data=data)

        expected = fill(add, messages, encoding, depth, count)
        writer.finish()
    return expected


def matrix(out, count):
    out.mkdir(parents=True, exist_ok=True)
    containers = [
        ("none.bag", lambda p, e, d: ros1(p, None, e, d, count)),
        ("lz4.bag", lambda p, e, d: ros1(p, "LZ4", e, d, count)),
        ("bz2.bag", lambda p, e, d: ros1(p, "BZ2", e, d, count)),
        ("db3", lambda p, e, d: ros2(p, StoragePlugin.SQLITE3, None, e, d, count)),
        ("db3-zstd-messages", lambda p, e, d: ros2(p, StoragePlugin.SQLITE3, CompressionMode.MESSAGE, e, d, count)),
        ("rosbag2-mcap", lambda p, e, d: ros2(p, StoragePlugin.MCAP, None, e, d, count)),
        ("none.mcap", lambda p, e, d: mcap(p, "NONE", e, d, count)),
        ("lz4.mcap", lambda p, e, d: mcap(p, "LZ4", e, d, count)),
        ("zstd.mcap", lambda p, e, d: mcap(p, "ZSTD", e, d, count)),
    ]
    # Every container with every encoding of colour; depth encodings in turn, so that each container meets each of them
    # once at least.
    listing = []
    for name, write in containers:
        for index, encoding in enumerate(ENCODINGS):
            depth = DEPTHS[index % len(DEPTHS)]
            file = f"{encoding}-{depth}-{name}"
            listing.append({"file": file, "encoding": encoding, "depth": depth, "images": write(out / file, encoding, depth)})
    (out / "expected.json").write_text(json.dumps(listing))
    print(f"{len(listing)} recordings of {count} images each in {out}")


def large(path, gigabytes):
    """An uncompressed MCAP of 1280 x 720 rgb8 with 16-bit depth at 15 Hz and joints at 125 Hz."""
    from mcap.writer import CompressionType
    from mcap.writer import Writer

    global WIDTH, HEIGHT
    WIDTH, HEIGHT = 1280, 720
    messages = Messages(ROS2, False)
    generator = np.random.default_rng(1)
    noise = generator.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    rgb = np.asarray(Pillow.fromarray(noise).resize((160, 90)).resize((WIDTH, HEIGHT)))
    counts = depth_counts(0)
    size = gigabytes * 1e9
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, chunk_size=4 << 20)
        writer.start(profile="ros2", library="write_recordings")
        kinds = {"/joint_states": "JointState", "/camera/image_raw": "Image", "/depth/image_raw": "Image", "/camera/camera_info": "CameraInfo", "/depth/camera_info": "CameraInfo"}
        channels = {}
        for topic, kind in kinds.items():
            schema = writer.register_schema(name=f"sensor_msgs/msg/{kind}", encoding="ros2msg", data=b"")
            channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)

        def add(topic, message, time):
            data = bytes(messages.serialize(message, f"sensor_msgs/msg/{kinds[topic]}"))
            writer.add_message(channels[topic], log_time=time, publish_time=time, data=data)

        tick, frame = 0, 0
        while file.tell() < size:
            stamp = START + tick * 8_000_000
            # 2 s at rest, 1 s of motion.
            cycle, phase = divmod(tick, 375)
            message = messages.joint_state(stamp, 0)
            message.position[:] = np.array([0.05 * k for k in range(7)]) + 0.1 * (cycle + max(phase - 250, 0) / 125)
            add("/joint_states", message, stamp)
            if tick % 8 == 0:
                shifted = np.roll(rgb, frame % 64, axis=1)
                add("/camera/image_raw", messages.raw(stamp, "color", "rgb8", shifted.tobytes(), 3 * WIDTH), stamp)
                add("/depth/image_raw", messages.raw(stamp + 1, "color", "16UC1", counts.tobytes(), 2 * WIDTH), stamp)
                add("/camera/camera_info", messages.info(stamp), stamp)
                add("/depth/camera_info", messages.info(stamp), stamp)
                frame += 1
            tick += 1
        writer.finish()
    print(f"{path}: {Path(path).stat().st_size / 1e9:.3f} GB, {frame} images, {tick} joint states")


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in ("matrix", "large"):
        sys.exit(__doc__)
    if sys.argv[1] == "matrix":
        matrix(Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 60)
    else:
        large(sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 2.0)
