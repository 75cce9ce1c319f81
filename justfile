# Habits. `just` lists them. Cargo alone does as well; each recipe is one or two plain commands.

[private]
default:
    @just --list

# All tests, as the README and .ci/run have them.
test *ARGS:
    cargo test --workspace --release {{ ARGS }}

# Clippy on everything, warnings are errors; then licences, duplicates and origins of dependencies (needs cargo-deny).
lint:
    cargo clippy --workspace --all-targets --release -- -D warnings
    cargo deny --locked check bans licenses sources

# Format all code.
fmt:
    cargo fmt --all

# The documentation of all crates; `just docs --open` shows it.
docs *ARGS:
    RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --release {{ ARGS }}

# The book in docs/, built anew as it changes; wants mdbook.
book:
    mdbook serve docs

# The paper's tables from the virtual cell; `just reproduce --quick` for the short version.
reproduce *ARGS:
    cargo run --release --bin skclam -- reproduce --out out/reproduce {{ ARGS }}

# AKAZE beside OpenCV's on the same images; wants Python and ../shared/data. `just bench-features speed` for a part.
bench-features *ARGS:
    python3 benchmarks/features/akaze_vs_opencv.py {{ ARGS }}

# Fusion beside Open3D; wants Python 3.11 and what the script's head names.
bench-mapping *ARGS:
    sh benchmarks/mapping/run.sh {{ ARGS }}

# Damaged recordings, rigs, URDFs, tables, maps, images: COUNT of each kind; `just fuzz 1000` for a look.
fuzz COUNT="1000000":
    SKCLAM_FUZZ={{ COUNT }} cargo test -p skclam-recordings --release --test mutations -- damaged --nocapture --test-threads=1
    SKCLAM_FUZZ={{ COUNT }} cargo test -p skclam --release --test mutated_files -- damaged --nocapture --test-threads=1

# Everything that must hold before a change lands.
ci:
    bash .ci/run
