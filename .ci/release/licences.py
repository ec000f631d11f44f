#!/usr/bin/env python3
"""Licences of all that a release of shearq is made of (of the package named, by default the program), as one text: crates
by what cargo knows of them, with the files that they bring, Rust's standard library, and the DejaVu that is built in.
Fails where a crate has no licence."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = ("licen", "copying", "notice", "copyright")
# The GPL of LZ4's programs, which are not built, and of zstd, which is also under the BSD licence.
LEFT_OUT = {"contrib", "examples", "programs", "tests"}
GPL = "GNU GENERAL PUBLIC LICENSE"


def metadata():
    host = next(
        line.split(": ")[1]
        for line in subprocess.check_output(["rustc", "-vV"], text=True).splitlines()
        if line.startswith("host: ")
    )
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--filter-platform", host]
    return json.loads(subprocess.check_output(command, cwd=ROOT))


def needed(data, name):
    """Packages that the package `name` is built with, those of its tests left out."""
    nodes = {node["id"]: node for node in data["resolve"]["nodes"]}
    packages = {package["id"]: package for package in data["packages"]}
    start = next(p["id"] for p in data["packages"] if p["name"] == name)
    seen, todo = set(), [start]
    while todo:
        here = todo.pop()
        if here in seen:
            continue
        seen.add(here)
        for dependency in nodes[here]["deps"]:
            if any(kind["kind"] != "dev" for kind in dependency["dep_kinds"]):
                todo.append(dependency["pkg"])
    # All members have the licence of shearq, but fitsio-sys.
    own = {p["id"] for p in data["packages"] if p["id"] in data["workspace_members"] and p["name"] != "fitsio-sys"}
    return sorted((packages[i] for i in seen - own), key=lambda p: (p["name"], p["version"]))


def texts(folder):
    """Licence files of a crate, and of the C sources that it brings (cfitsio, LZ4, zstd), by their paths."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name.lower().startswith(FILES) and path.suffix not in (".rs", ".c", ".h", ".py"):
            place = path.relative_to(folder)
            text = path.read_text(errors="replace").strip()
            if not text.startswith(GPL) and LEFT_OUT.isdisjoint(place.parts):
                yield place, text


def main():
    packages = needed(metadata(), sys.argv[1] if len(sys.argv) > 1 else "shearq")
    bare = [p["name"] for p in packages if not (p["license"] or p["license_file"])]
    if bare:
        sys.exit(f"crates without a licence: {', '.join(bare)}")
    print("shearq is built with the following. Texts follow in the same order; crates without a text of their own name their authors.\n")
    places = []
    for p in packages:
        found = list(texts(Path(p["manifest_path"]).parent))
        places += [(f"{p['name']}: {path}", text) for path, text in found]
        authors = "" if found else f" ({', '.join(p['authors']) or p['repository']})"
        print(f"{p['name']} {p['version']}: {p['license'] or p['license_file']}{authors}")
    print("The standard library of Rust: MIT OR Apache-2.0 (the Rust project contributors, https://github.com/rust-lang/rust)")
    print("DejaVu Sans: DejaVuSans-LICENSE.txt")
    font = ROOT / "crates" / "render" / "fonts" / "DejaVuSans-LICENSE.txt"
    places.append((f"DejaVu Sans: {font.name}", font.read_text().strip()))
    once = {}
    for name, text in places:
        once.setdefault(text, []).append(name)
    for text, names in once.items():
        print("\n" + "=" * 80 + "\n" + "\n".join(dict.fromkeys(names)) + "\n" + "=" * 80 + "\n\n" + text)


if __name__ == "__main__":
    main()
