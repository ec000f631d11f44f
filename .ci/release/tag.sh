#!/usr/bin/env bash
# Makes a release of the version in Cargo.toml, up to the push: checks, archive, a trial of the crates, and a signed or plain tag.
#     bash .ci/release/tag.sh DIST [--tag]
# Without --tag it is a rehearsal, which changes nothing in the repository.
set -euo pipefail
cd "$(dirname "$0")/../.."
dist=${1:?usage: .ci/release/tag.sh DIST [--tag]}
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
fail() { echo "error: $*" >&2; exit 1; }

# The other crates have `publish = false`.
published=(-p shearq-quantities -p shearq-submissions -p shearq-bias -p shearq-scoring -p shearq-measure)

[ -z "$(git status --porcelain)" ] || fail "uncommitted changes. Try: git stash"
git rev-parse -q --verify "refs/tags/v$version" > /dev/null && fail "the tag v$version exists. Try: a new version in Cargo.toml"
grep -q "^version: $version\$" CITATION.cff || fail "CITATION.cff: expected version: $version"
grep -q "^  version: \"$version\"\$" packaging/conda-forge/recipe.yaml || fail "packaging/conda-forge/recipe.yaml: expected version: \"$version\""
grep -q "^## .*$version" CHANGELOG.md || fail "CHANGELOG.md: expected a section of $version"
# What README, documents and packages say before a release. A rehearsal does not mind.
if [ "${2:-}" = --tag ]; then
    ! grep -nE "^Version .* not released|^## $version \(not released\)|not published yet|not public yet" README.md CHANGELOG.md CONTRIBUTING.md docs/install.md ||
        fail "the lines above are of the time before the release. Try: new lines, and a commit"
fi

bash .ci/run
cargo test --release -- --ignored
cargo package --locked "${published[@]}"
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
python3 -m venv "$tools"
"$tools/bin/pip" install --quiet 'maturin[zig]>=1.9,<2' cargo-zigbuild twine auditwheel
export PATH=$tools/bin:$PATH
bash .ci/release/archive.sh "$dist"
DIST=$(realpath "$dist")/python sh python/wheels.sh
if [ "${2:-}" = --tag ]; then
    git tag -a "v$version" -m "shearq $version"
    echo "Publish by: git push origin v$version && cargo publish ${published[*]}"
fi
