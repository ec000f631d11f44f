#!/usr/bin/env bash
# The documents as a site: main in the folder itself, and each tag vVERSION in a folder of its name. Needs mdbook.
#     bash .ci/release/site.sh FOLDER
set -euo pipefail
cd "$(dirname "$0")/../.."
out=${1:?usage: .ci/release/site.sh FOLDER}
mkdir -p "$out"
out=$(cd "$out" && pwd)
mdbook build docs --dest-dir "$out"
trees=$(mktemp -d)
trap 'rm -rf "$trees"' EXIT
for tag in $(git tag --list 'v*'); do
    # Versions before the site have no book.
    git cat-file -e "$tag:docs/book.toml" 2> /dev/null || continue
    mkdir "$trees/$tag"
    git archive "$tag" | tar -x -C "$trees/$tag"
    mdbook build "$trees/$tag/docs" --dest-dir "$out/$tag"
done
