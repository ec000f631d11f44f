#!/usr/bin/env python3
"""Formulas of the pages as MathML, so that the site needs neither a script nor the network: a preprocessor of mdbook.

$…$ and $$…$$ are formulas, as on GitHub. Needs latex2mathml; without it they stay as they are.
"""

import json
import re
import sys

try:
    from latex2mathml.converter import convert
except ImportError:
    convert = None

#: Code, which has no formulas, or a formula.
PARTS = re.compile(r"(?P<code>```.*?```|`[^`\n]*`)|\$\$(?P<block>.+?)\$\$|\$(?P<line>[^$\n]+?)\$", re.DOTALL)


def formula(found):
    if found["code"]:
        return found["code"]
    block = found["block"] is not None
    mathml = convert((found["block"] if block else found["line"]).strip(), display="block" if block else "inline")
    # A blank line would end the element.
    return f"\n\n{mathml}\n\n" if block else mathml


def chapters(items):
    for item in items:
        if "Chapter" in item:
            yield item["Chapter"]
            yield from chapters(item["Chapter"]["sub_items"])


def main():
    if sys.argv[1:2] == ["supports"]:
        return
    _, book = json.load(sys.stdin)
    if convert:
        for chapter in chapters(book.get("sections", book.get("items", []))):
            chapter["content"] = PARTS.sub(formula, chapter["content"])
    json.dump(book, sys.stdout)


if __name__ == "__main__":
    main()
