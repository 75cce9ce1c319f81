#!/bin/sh
# Fusion beside Open3D: time, memory, accuracy and completeness at the datasets' known poses, and at those of a calibrated
# and of the nominal rig; long runs.
# Usage: benchmarks/mapping/run.sh [WORK_DIR]; wants Python 3.11 and, for Open3D, the system libraries libusb-1.0-0,
# libgl1, libgomp1 and libx11-6. Data: SKCLAM_DATA or ../shared/data. One line of JSON a measurement on stdout.
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/benchmark-mapping}
data=${SKCLAM_DATA:-../shared/data}
mkdir -p "$work"
[ -x "$work/venv/bin/python" ] || python3 -m venv "$work/venv"
"$work/venv/bin/python" -c 'import open3d' 2>/dev/null || "$work/venv/bin/pip" install -q open3d==0.20.0
cargo build --release -q -p skclam-mapping --example benchmark_fusion --example score_map
cargo build --release -q -p skclam-cli
target=${CARGO_TARGET_DIR:-target}/release
bin=$target/examples
export RAYON_NUM_THREADS=2 OMP_NUM_THREADS=2

for set in virtual-cell apc-shelf; do
    for voxel in 10 5; do
        echo "# $set, $voxel mm"
        "$bin/benchmark_fusion" "$data/$set" $voxel "$work/ours.ply"
        "$work/venv/bin/python" benchmarks/mapping/open3d_fusion.py "$data/$set" $voxel "$work/theirs.ply" 16
        "$work/venv/bin/python" benchmarks/mapping/open3d_fusion.py "$data/$set" $voxel "$work/theirs8.ply" 8
        if [ "$set" = virtual-cell ]; then
            echo "# scores: ours, Open3D with its weight threshold 3, Open3D with 1"
            "$bin/score_map" "$data/$set" "$work/ours.ply"
            "$bin/score_map" "$data/$set" "$work/theirs.ply"
            "$work/venv/bin/python" benchmarks/mapping/open3d_fusion.py "$data/$set" $voxel "$work/theirs1.ply" 16 1 1 > /dev/null
            "$bin/score_map" "$data/$set" "$work/theirs1.ply"
        fi
    done
done
echo "# virtual-cell at the poses of the true, the calibrated and the nominal rig, after the base's gauge"
cell=$data/virtual-cell
"$target/skclam" run -q --threads 2 "$cell" --out "$work/run" > /dev/null
for voxel in 10 5; do
    for rig in truth calibrated nominal; do
        case $rig in
            truth) file=$cell/truth/rig.toml ;;
            calibrated) file=$work/run/rig.toml ;;
            nominal) file=$cell/rig.toml ;;
        esac
        map=$work/map-$rig-$voxel
        "$target/skclam" map -q --threads 2 "$cell" --rig "$file" --voxel-mm "$voxel" --also mesh --out "$map" > /dev/null
        cp "$file" "$map/rig.toml"
        "$target/skclam" evaluate --json "$map" --truth "$cell/truth/rig.toml" --dataset "$cell" \
            --surface "$cell/truth/scene.ply" > "$map/score.json"
        python3 benchmarks/mapping/score_line.py "$rig" "$voxel" "$map/score.json"
        rm -rf "$map"
    done
done
echo "# 10,032 images (209 passes), 20 mm: memory against that of one pass"
"$bin/benchmark_fusion" "$data/virtual-cell" 20 "$work/ours.ply" 1
"$bin/benchmark_fusion" "$data/virtual-cell" 20 "$work/ours.ply" 209
echo "# 1,008 images (21 passes), 10 mm: does the time an image grow?"
"$bin/benchmark_fusion" "$data/virtual-cell" 10 "$work/ours.ply" 21
rm -f "$work"/*.ply
