#!/bin/sh
# Fusion beside Open3D: time, memory, accuracy and completeness at the datasets' known poses, and at those of a calibrated
# and of the nominal rig; long runs. About ten minutes.
# Usage: benchmarks/mapping/run.sh [WORK_DIR]; wants Python 3.11 and, for Open3D, the system libraries libusb-1.0-0,
# libgl1, libgomp1 and libx11-6 and 6 GiB of memory. Data: SKCLAM_DATA or ../shared/data.
# PYTHON names an interpreter that has open3d already. One line of JSON a measurement, and one table at the end.
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/benchmark-mapping}
data=${SKCLAM_DATA:-../shared/data}
mkdir -p "$work"
if [ -z "${PYTHON:-}" ]; then
    PYTHON=$work/venv/bin/python
    [ -x "$PYTHON" ] || python3 -m venv "$work/venv"
    "$PYTHON" -c 'import open3d' 2>/dev/null || "$PYTHON" -m pip install -q open3d==0.20.0
fi
cargo build --release -q -p skclam-mapping --example benchmark_fusion --example score_map
cargo build --release -q -p skclam-cli
target=${CARGO_TARGET_DIR:-target}/release
export RAYON_NUM_THREADS=2 OMP_NUM_THREADS=2
log=$work/log.jsonl
: > "$log"

# measure NAME COMMAND...: runs the command, whose output is one line of JSON, under a name.
measure() {
    name=$1
    shift
    # Open3D says more than our line.
    "$@" > "$work/output.txt"
    grep "^{" "$work/output.txt" > "$work/line.json"
    printf '{"name": "%s", "result": %s}\n' "$name" "$(cat "$work/line.json")" | tee -a "$log"
}
ours() {
    name=$1
    shift
    measure "$name" "$target/examples/benchmark_fusion" "$@"
}
theirs() {
    name=$1
    shift
    measure "$name" "$PYTHON" benchmarks/mapping/open3d_fusion.py "$@"
}

cell=$data/virtual-cell
for voxel in 10 5; do
    ours "cell $voxel ours" "$cell" $voxel "$work/ours.ply"
    theirs "cell $voxel open3d-16" "$cell" $voxel "$work/theirs.ply" 16 1 "$work/theirs1.ply"
    theirs "cell $voxel open3d-8" "$cell" $voxel "$work/theirs8.ply" 8
    for map in ours theirs theirs1; do
        measure "score $voxel $map" "$target/examples/score_map" "$cell" "$work/$map.ply"
    done
    # Fifteen images: four passes, for the clock's sake.
    ours "shelf $voxel ours" "$data/apc-shelf" $voxel "$work/ours.ply" 4
    theirs "shelf $voxel open3d-16" "$data/apc-shelf" $voxel "$work/theirs.ply" 16 4
    theirs "shelf $voxel open3d-8" "$data/apc-shelf" $voxel "$work/theirs.ply" 8 4
done

# The same surface at the poses of the true, the calibrated and the nominal rig, compared after the base's gauge.
rm -rf "$work/run"
"$target/skclam" run -q --threads 2 "$cell" --out "$work/run" > /dev/null
for voxel in 10 5; do
    for rig in truth calibrated nominal; do
        case $rig in
            truth) file=$cell/truth/rig.toml ;;
            calibrated) file=$work/run/rig.toml ;;
            nominal) file=$cell/rig.toml ;;
        esac
        map=$work/map-$rig-$voxel
        rm -rf "$map"
        "$target/skclam" map -q --threads 2 "$cell" --rig "$file" --voxel-mm "$voxel" --also mesh --out "$map" > /dev/null
        cp "$file" "$map/rig.toml"
        "$target/skclam" evaluate --json "$map" --truth "$cell/truth/rig.toml" --dataset "$cell" \
            --surface "$cell/truth/scene.ply" > "$map/score.json"
        measure "rig $voxel $rig" python3 benchmarks/mapping/score_line.py "$rig" "$voxel" "$map/score.json"
        rm -rf "$map"
    done
done

# 10,032 images (209 passes), 20 mm: memory against that of one pass. 1,008 images (21 passes): does the time grow?
ours "memory once" "$cell" 20 "$work/ours.ply" 1
ours "memory long" "$cell" 20 "$work/ours.ply" 209
ours "flat" "$cell" 10 "$work/ours.ply" 21
rm -f "$work"/*.ply
python3 benchmarks/mapping/table.py "$log"
