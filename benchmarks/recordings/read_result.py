#!/usr/bin/env python3
"""Reads a result.mcap of `skclam export --mcap` with independent libraries and prints what is in it as JSON.

    python3 -m venv venv && venv/bin/pip install mcap mcap-protobuf-support foxglove-schemas-protobuf
    venv/bin/python benchmarks/recordings/read_result.py RESULT.mcap

Every checksum of the file is verified; every message is decoded twice, by the schema in the file and by the published
classes, and both must say the same. The tree of frames is walked from the camera to the base at every posture.
"""

import importlib
import json
import math
import struct
import sys
import zlib

from mcap.reader import make_reader
from mcap.records import Attachment, Message
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory


def product(a, b):
    """Of two quaternions x y z w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz)


def turned(q, v):
    conjugate = (-q[0], -q[1], -q[2], q[3])
    return product(product(q, (*v, 0.0)), conjugate)[:3]


def xyz(v):
    return (v.x, v.y, v.z)


def xyzw(q):
    return (q.x, q.y, q.z, q.w)


def walk(edges, frame, base):
    """base_from_frame, from the frame upwards: translation and quaternion."""
    translation, rotation = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    steps = 0
    while frame != base:
        edge = edges[frame]
        t, q = xyz(edge.translation), xyzw(edge.rotation)
        translation = tuple(a + b for a, b in zip(turned(q, translation), t))
        rotation = product(q, rotation)
        frame = edge.parent_frame_id
        steps += 1
        assert steps < 100, "a loop in the tree of frames"
    return translation, rotation


def same_pose(a, b):
    translation = max(abs(x - y) for x, y in zip(a[0], b[0]))
    dot = abs(sum(x * y for x, y in zip(a[1], b[1])))
    return translation < 1e-9 and dot > 1 - 1e-12


def listed(poses):
    return [[*xyz(pose.position), *xyzw(pose.orientation)] for pose in poses]


def cloud(message):
    fields = {field.name: (field.offset, field.type) for field in message.fields}
    assert {"x", "y", "z"} <= fields.keys() and all(fields[axis][1] == 7 for axis in "xyz"), fields
    # Once: each access to the field copies it.
    data, stride = message.data, message.point_stride
    count, rest = divmod(len(data), stride)
    assert rest == 0
    points = [struct.unpack_from("<fff", data, at) for at in range(0, len(data), stride)]
    colors = 0
    if "red" in fields:
        red = fields["red"][0]
        colors = zlib.crc32(b"".join(data[at + red:at + red + 3] for at in range(0, len(data), stride)))
    return {"points": count, "first": points[0], "last": points[-1],
            "sum": [math.fsum(point[axis] for point in points) for axis in range(3)], "color_crc": colors}


def main(path):
    with open(path, "rb") as file:
        kinds = [type(record) for record in StreamReader(file, validate_crcs=True).records]
    print(f"{len(kinds)} records, checksums right", file=sys.stderr)
    out = {"topics": {}, "trajectory": {}, "map": {}, "images": [], "depth": [], "residuals": {}, "frames": [],
           "attachments": {}, "stamps": []}
    tf, poses = {}, {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values())
        assert kinds.count(Attachment) == summary.statistics.attachment_count
        for attachment in reader.iter_attachments():
            out["attachments"][attachment.name] = zlib.crc32(attachment.data)
        for metadata in reader.iter_metadata():
            out["metadata"] = metadata.metadata
        read = 0
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            read += 1
            package, name = schema.name.split(".")
            assert package == "foxglove" and schema.encoding == channel.message_encoding == "protobuf"
            published = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
            other = published.FromString(message.data)
            assert other.SerializeToString(deterministic=True) == decoded.SerializeToString(deterministic=True), name
            topic = out["topics"].setdefault(channel.topic, {"schema": schema.name, "messages": 0})
            topic["messages"] += 1
            prefix = "nominal" if channel.topic.startswith("/nominal/") else "calibrated"
            if hasattr(decoded, "timestamp"):
                assert decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos == message.log_time
            if name == "PosesInFrame":
                out["trajectory"][prefix] = listed(decoded.poses)
            elif name == "PoseInFrame":
                poses[prefix, message.log_time] = (xyz(decoded.pose.position), xyzw(decoded.pose.orientation))
            elif name == "FrameTransforms":
                tf[message.log_time] = {edge.child_frame_id: edge for edge in decoded.transforms}
                assert len(tf[message.log_time]) == len(decoded.transforms), "a frame with two parents"
                out["frames"] = sorted(tf[message.log_time])
                out["stamps"].append(message.log_time * 1e-9)
            elif name == "PointCloud":
                out["map"][prefix] = cloud(decoded)
            elif name == "CompressedImage":
                out["images"].append({"format": decoded.format, "crc": zlib.crc32(decoded.data)})
            elif name == "RawImage":
                assert decoded.encoding == "16UC1" and len(decoded.data) == decoded.step * decoded.height
                out["depth"].append(zlib.crc32(decoded.data))
            elif name == "CameraCalibration" and channel.topic.endswith("/camera/calibration"):
                out.setdefault("camera", {})[prefix] = [*decoded.K, *decoded.D]
            elif name == "ImageAnnotations":
                lines = next(points for points in decoded.points if points.type == 4)
                ends = [(point.x, point.y) for point in lines.points]
                lengths = sorted(math.dist(a, b) for a, b in zip(ends[::2], ends[1::2]))
                out["residuals"].setdefault(prefix, []).append(
                    {"lines": len(lengths), "median": lengths[len(lengths) // 2], "text": decoded.texts[0].text})
        assert read == summary.statistics.message_count == kinds.count(Message) or kinds.count(Message) == 0
    for (prefix, time), pose in poses.items():
        frame = ("nominal/" if prefix == "nominal" else "") + "camera_color_optical_frame"
        assert same_pose(walk(tf[time], frame, "base"), pose), f"{prefix}: /tf and pose differ"
    json.dump(out, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
