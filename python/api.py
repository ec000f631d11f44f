"""Writes docs/python-api.md from the docstrings of the package; with --check, compares it."""

import inspect
import pathlib
import sys

import shearq

PAGE = pathlib.Path(__file__).parent.parent / "docs" / "python-api.md"
HEAD = """# Python API

This page is made from the docstrings by `python python/api.py`. [Tutorial 2](own-images.md) introduces the package.
"""


def documented(value: object) -> str:
    """The docstring as a code block."""
    return f"```text\n{inspect.getdoc(value) or ''}\n```\n"


def signature(value: object) -> str:
    """The names of the parameters and their defaults, without types."""
    try:
        parameters = inspect.signature(value).parameters.values()  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return ""
    plain = [parameter.replace(annotation=parameter.empty) for parameter in parameters if parameter.name != "self"]
    shown = str(inspect.Signature(plain))
    # Defaults that are objects have an address, which differs between runs.
    return "(…)" if " at 0x" in shown else shown


def members(kind: type) -> list[tuple[str, object]]:
    """Public methods and properties that the class itself defines and documents."""
    found = [(name, value) for name, value in vars(kind).items() if not name.startswith("_")]
    return [(name, value) for name, value in found if inspect.getdoc(value) and (callable(value) or isinstance(value, property))]


def page() -> str:
    """The page."""
    parts = [HEAD]
    for name in sorted(vars(shearq), key=str.lower):
        if name.startswith("_"):
            continue
        value = getattr(shearq, name)
        if inspect.ismodule(value) or not callable(value):
            continue
        is_class = inspect.isclass(value)
        parts.append(f"## {name}\n\n```text\n{'class ' if is_class else ''}{name}{'' if is_class else signature(value)}\n```\n")
        parts.append(documented(value))
        for member, method in members(value) if is_class else []:
            shown = "" if isinstance(method, property) else signature(method)
            parts.append(f"### {name}.{member}\n\n```text\n{member}{shown}\n```\n")
            parts.append(documented(method))
    return "\n".join(parts)


def main() -> int:
    """Writes or compares the page."""
    found = page()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(found, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != found:
        print(f"{PAGE} differs from the docstrings. Try: python python/api.py", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
