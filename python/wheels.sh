#!/bin/sh
# Builds wheels for Linux and the source distribution into dist/ (or $DIST), and checks them.
#
# Usage: python/wheels.sh [TARGET...]     default: x86_64-unknown-linux-gnu
#
# Needs `pip install 'maturin[zig]' twine auditwheel`. Zig links against glibc 2.17, so that wheels are manylinux2014; it also
# compiles cfitsio for other targets, such as aarch64-unknown-linux-gnu (`rustup target add` it first).
# One wheel per target serves Python 3.10 and later.
set -eu
cd "$(dirname "$0")"
here=$PWD
root=$(dirname "$PWD")
dist=${DIST:-$PWD/../dist}
mkdir -p "$dist"
# cfitsio's and LZ4's notices must be in all copies.
python3 ../.ci/release/licences.py shearq-python > LICENCES-OF-DEPENDENCIES.txt
trap 'rm -f LICENCES-OF-DEPENDENCIES.txt' EXIT
# No path of this machine in the module.
export RUSTFLAGS="--remap-path-prefix=$root=. --remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}=cargo --remap-path-prefix=${CARGO_TARGET_DIR:-$root/target}=target ${RUSTFLAGS:-}"
for target in "${@:-x86_64-unknown-linux-gnu}"; do
    case $target in
        *-linux-*) maturin build --profile dist --zig --compatibility manylinux2014 --target "$target" --out "$dist" ;;
        *) maturin build --profile dist --target "$target" --out "$dist" ;;
    esac
done
maturin sdist --out "$dist"
twine check "$dist"/*
for wheel in "$dist"/*linux*.whl; do
    [ ! -e "$wheel" ] || auditwheel show "$wheel"
done
# The wheel of this machine must measure in an empty environment.
own=$(ls "$dist"/*"$(uname -m)".whl)
unzip -l "$own" | grep -q LICENCES-OF-DEPENDENCIES || { echo "error: $own: has no licences of dependencies" >&2; exit 1; }
! unzip -p "$own" | grep -aqF "$root/" || { echo "error: $own: has paths of this machine" >&2; exit 1; }
empty=$(mktemp -d)
trap 'rm -rf "$empty" "$here/LICENCES-OF-DEPENDENCIES.txt"' EXIT
python3 -m venv "$empty"
"$empty/bin/pip" install --quiet "$own"
cd "$empty"
"$empty/bin/python" - <<'PYTHON'
import shearq
image = shearq.simulate(set=8, seed=1, grid=8)[0]
print(shearq.__version__, shearq.measure(image.stamps, image.psf).mean_shear())
PYTHON
"$empty/bin/shearq" --version
