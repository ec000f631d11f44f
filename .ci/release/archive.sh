#!/usr/bin/env bash
# Makes what is published of a release, in the folder named: an archive with the binary, a Debian package where
# dpkg-deb is there, and their checksums. Reproducible: the same commit and compiler give the same bytes.
# On Linux it needs `pip install cargo-zigbuild`, which links against glibc 2.17, so that the binary runs on older systems.
set -euo pipefail
cd "$(dirname "$0")/../.."
out=${1:?usage: .ci/release/archive.sh FOLDER}
mkdir -p "$out"
out=$(cd "$out" && pwd)
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
host=$(rustc -vV | sed -n 's/^host: //p')
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
# No path of this machine in the binary. The same flags as in python/wheels.sh, so that both share their dependencies.
export RUSTFLAGS="--remap-path-prefix=$PWD=. --remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}=cargo --remap-path-prefix=${CARGO_TARGET_DIR:-$PWD/target}=target ${RUSTFLAGS:-}"
# `shearq --version` says it.
SHEARQ_COMMIT=$(git rev-parse --short=12 HEAD)
export SHEARQ_COMMIT
case $host in
    *-linux-gnu) build=zigbuild glibc=.2.17 ;;
    *) build=build glibc= ;;
esac
[ -n "${SHEARQ:-}" ] || cargo $build --profile dist --locked --bin shearq --target "$host$glibc"
binary=${SHEARQ:-${CARGO_TARGET_DIR:-target}/$host/dist/shearq}

stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
name=shearq-$version-$host
tree=$stage/$name
mkdir -p "$tree/completions"
install -m 755 "$binary" "$tree/shearq"
strip "$tree/shearq"
cp README.md CHANGELOG.md CONTRIBUTING.md CITATION.cff LICENSE-MIT LICENSE-APACHE "$tree"
cp -r docs "$tree/docs"
python3 .ci/release/licences.py > "$tree/LICENCES-OF-DEPENDENCIES.txt"
for shell in bash zsh fish; do
    "$binary" completions "$shell" > "$tree/completions/shearq.$shell"
done
"$binary" --quiet man --out "$tree/man"
# tar of macOS cannot sort, and has no owners by number.
python3 - "$stage" "$name" "$out/$name.tar.gz" <<'PYTHON'
import gzip, os, sys, tarfile
stage, name, out = sys.argv[1:]
time = int(os.environ["SOURCE_DATE_EPOCH"])
def plain(entry):
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    entry.mtime = time
    return entry
with open(out, "wb") as file, gzip.GzipFile("", "wb", 9, file, time) as packed:
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        # Members of folders are added by their sorted names.
        archive.add(os.path.join(stage, name), name, filter=plain)
PYTHON

made=("$name.tar.gz")
if command -v dpkg-deb > /dev/null; then
    root=$stage/debian
    doc=$root/usr/share/doc/shearq
    maintainer="the authors of shearq <shearq@users.noreply.github.com>"
    share=$root/usr/share
    mkdir -p "$root/DEBIAN" "$root/usr/bin" "$share/man/man1" "$doc"
    mkdir -p "$share/bash-completion/completions" "$share/zsh/vendor-completions" "$share/fish/vendor_completions.d"
    install -m 755 "$tree/shearq" "$root/usr/bin/shearq"
    cp "$tree/completions/shearq.bash" "$share/bash-completion/completions/shearq"
    cp "$tree/completions/shearq.zsh" "$share/zsh/vendor-completions/_shearq"
    cp "$tree/completions/shearq.fish" "$share/fish/vendor_completions.d"
    cp "$tree"/man/*.1 "$share/man/man1"
    gzip -n -9 "$share"/man/man1/*.1
    cp -r README.md CHANGELOG.md CONTRIBUTING.md CITATION.cff docs "$doc"
    gzip -n -9 > "$doc/changelog.gz" << CHANGELOG
shearq ($version) unstable; urgency=medium

  * Changes are in CHANGELOG.md beside this file.

 -- $maintainer  $(LC_ALL=C date -u -R -d "@$SOURCE_DATE_EPOCH")
CHANGELOG
    {
        echo "shearq, https://github.com/shearq/shearq, is licensed under either of MIT and Apache-2.0, at your option."
        echo "The text of Apache-2.0 is in /usr/share/common-licenses/Apache-2.0, that of MIT is:"
        echo
        cat LICENSE-MIT
        echo
        cat "$tree/LICENCES-OF-DEPENDENCIES.txt"
    } > "$doc/copyright"
    cat > "$root/DEBIAN/control" << CONTROL
Package: shearq
Version: $version
Architecture: $(dpkg --print-architecture)
Maintainer: $maintainer
Depends: libc6 (>= 2.17)
Installed-Size: $(du -sk --apparent-size "$root/usr" | cut -f1)
Section: science
Priority: optional
Homepage: https://github.com/shearq/shearq
Description: m and c of weak-lensing shear catalogues, galaxy shapes, scores
 Determines the multiplicative and additive bias of shear catalogues of any
 program, measures galaxy shapes with their shear responses, scores methods
 as the GREAT challenges did, and runs challenges.
CONTROL
    (cd "$root" && find usr -type f | LC_ALL=C sort | xargs md5sum > DEBIAN/md5sums)
    find "$root" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
    package=shearq_${version}_$(dpkg --print-architecture).deb
    dpkg-deb --root-owner-group --build "$root" "$out/$package" > /dev/null
    made+=("$package")
fi
# Of this target alone: a release has one such file for each.
cd "$out"
if command -v sha256sum > /dev/null; then sum=(sha256sum); else sum=(shasum -a 256); fi
"${sum[@]}" "${made[@]}" | tee "$name.sha256"
