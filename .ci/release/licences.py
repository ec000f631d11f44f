#!/usr/bin/env python3
"""Licences of all that a release of shearq is made of (of the package named, by default the program), as one text: crates by what cargo knows of them, with the files
that they bring, and the DejaVu that is built in. Fails where a crate has no licence."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = ("licen", "copying", "notice", "copyright")


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
    """Licence files of a crate, and of the C sources that it brings (cfitsio, LZ4, zstd)."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name.lower().startswith(FILES) and path.suffix not in (".rs", ".c", ".h", ".py"):
            yield path


def main():
    packages = needed(metadata(), sys.argv[1] if len(sys.argv) > 1 else "shearq")
    bare = [p["name"] for p in packages if not (p["license"] or p["license_file"])]
    if bare:
        sys.exit(f"crates without a licence: {', '.join(bare)}")
    print("shearq is built with the following. Texts follow in the same order.\n")
    for p in packages:
        print(f"{p['name']} {p['version']}: {p['license'] or p['license_file']}")
    print("DejaVu Sans: DejaVuSans-LICENSE")
    places = [(p["name"], path) for p in packages for path in texts(Path(p["manifest_path"]).parent)]
    places.append(("DejaVu Sans", ROOT / "crates" / "render" / "fonts" / "DejaVuSans-LICENSE.txt"))
    once = {}
    for name, path in places:
        text = path.read_text(errors="replace").strip()
        once.setdefault(text, []).append(f"{name}: {path.name}")
    for text, names in once.items():
        print("\n" + "=" * 80 + "\n" + "\n".join(dict.fromkeys(names)) + "\n" + "=" * 80 + "\n\n" + text)


if __name__ == "__main__":
    main()
