#!/usr/bin/env python3
"""Writes recordings with independent libraries (rosbags, mcap), for the tests and for the import benchmark.

    python3 -m venv venv && venv/bin/pip install rosbags mcap numpy pillow
    venv/bin/python benchmarks/recordings/write_recordings.py matrix OUT [MESSAGES]
    venv/bin/python benchmarks/recordings/write_recordings.py large OUT.mcap [GIGABYTES]
    venv/bin/python benchmarks/recordings/write_recordings.py viewer OUT

`matrix` writes every container, compression and encoding that the importer reads, MESSAGES colour images each, and
`expected.json` with what is in them (joints, CRC-32 of the pixels). The arm stands, moves, stands, ...
`viewer` writes viewer.bag and viewer_older.bag with the topics, types and times of the RealSense Viewer (librealsense,
src/media/ros), and joints.csv beside them.
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


def viewer_bag(path, compression, image_type_has_units):
    """Two sensors of one device: depth 32 x 24 in tenths of a millimetre, colour 64 x 48, 30 Hz, three stationary intervals.

    Static information is logged at time 1 ns, images under the time since the start of the recording; the headers of images
    hold the camera's clock, those of camera_info nothing.
    """
    types = dict(ROS1.types)
    store = get_typestore(Stores.ROS1_NOETIC)
    # The Viewer appends the metres a count to its depth images; its type keeps the name sensor_msgs/Image.
    messages = Messages(store, True)
    writer = Writer1(path)
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    static = 1
    with writer:
        connections = {}

        def raw(topic, kind, data, time):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, data)

        def add(topic, kind, time, **fields):
            raw(topic, kind, store.serialize_ros1(types[kind](**fields), kind), time)

        def key_value(topic, key, value, time=static):
            add(topic, "diagnostic_msgs/msg/KeyValue", time, key=key, value=value)

        add("/file_version", "std_msgs/msg/UInt32", static, data=4 if image_type_has_units else 3)
        key_value("/device_0/info", "Name", "Intel RealSense D405")
        key_value("/device_0/info", "Serial Number", "123")
        sensors = [
            (0, "Depth", "mono16", 32, 24, (40.0, 41.0, 15.5, 11.5), [0.0] * 5),
            (1, "Color", "rgb8", 64, 48, (80.0, 81.0, 31.5, 23.5), [-0.05, 0.06, 0.001, -0.002, 0.01]),
        ]
        vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        for sensor, stream, encoding, width, height, (fx, fy, cx, cy), distortion in sensors:
            prefix = f"/device_0/sensor_{sensor}"
            key_value(f"{prefix}/info", "Name", "Stereo Module" if sensor == 0 else "RGB Camera")
            for option, value in [("Exposure", 33000.0), ("Gain", 16.0)] + ([("Depth Units", 1e-4)] if sensor == 0 else []):
                add(f"{prefix}/option/{option}/value", "std_msgs/msg/Float32", static, data=value)
                add(f"{prefix}/option/{option}/description", "std_msgs/msg/String", static, data="what it does")
            info = messages.info(0)
            info.header = messages.header(0, "")
            info.width, info.height = width, height
            info.distortion_model = "None" if sensor == 0 else "Inverse Brown Conrady"
            info.D = np.array(distortion)
            info.K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
            info.R, info.P = np.zeros(9), np.zeros(12)
            kind = "sensor_msgs/msg/CameraInfo"
            raw(f"{prefix}/{stream}_0/info/camera_info", kind, store.serialize_ros1(info, kind), static)
        frames = 3 * 45
        for step in range(frames):
            # A stand of a second, half a second of motion.
            time = 1_000_000 + step * 33_333_333
            for sensor, stream, encoding, width, height, _, _ in sensors:
                prefix = f"/device_0/sensor_{sensor}/{stream}_0"
                generator = np.random.default_rng(100 * (step // 45) + sensor)
                if stream == "Depth":
                    data = generator.integers(2000, 40000, (height, width), dtype=np.uint16).tobytes()
                else:
                    data = generator.integers(0, 256, (height, width, 3), dtype=np.uint8).tobytes()
                image = messages.raw(START + time + 1000 * sensor, "", encoding, data, len(data) // height)
                image.width, image.height = width, height
                bytes_ = bytes(store.serialize_ros1(image, "sensor_msgs/msg/Image"))
                if image_type_has_units:
                    bytes_ += struct.pack("<f", 1e-4 if stream == "Depth" else 0.0)
                raw(f"{prefix}/image/data", "sensor_msgs/msg/Image", bytes_, time)
                key_value(f"{prefix}/image/metadata", "system_time", f"{(START + time) * 1e-6:.6f}", time)
                key_value(f"{prefix}/image/metadata", "timestamp_domain", "Global Time", time)
                if step == 0:
                    # What takes a point of the reference stream to this one.
                    moved = vector(0.015, -0.0002, 0.0004) if stream == "Color" else vector(0.0, 0.0, 0.0)
                    turned = quaternion(0.0, 0.0, np.sin(0.005), np.cos(0.005)) if stream == "Color" else quaternion(0, 0, 0, 1)
                    add(f"{prefix}/tf/0", "geometry_msgs/msg/Transform", static, translation=moved, rotation=turned)


def viewer(out):
    out.mkdir(parents=True, exist_ok=True)
    viewer_bag(out / "viewer.bag", "LZ4", True)
    viewer_bag(out / "viewer_older.bag", None, False)
    lines = ["timestamp_s,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"]
    for step in range(3 * 45 * 2):
        seconds, phase = step / 60.0, (step % 90) / 90.0
        share = step // 90 + max(phase - 2 / 3, 0) * 3
        values = ",".join(f"{10.0 * k + 5.0 * share:.6f}" for k in range(1, 7))
        # The robot's own clock, a hundred seconds late.
        lines.append(f"{START / 1e9 + seconds - 100.0:.6f},{values}")
    (out / "joints.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in ("matrix", "large", "viewer"):
        sys.exit(__doc__)
    if sys.argv[1] == "viewer":
        viewer(Path(sys.argv[2]))
    elif sys.argv[1] == "matrix":
        matrix(Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 60)
    else:
        large(sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 2.0)
