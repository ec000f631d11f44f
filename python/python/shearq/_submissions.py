"""Named configurations, and those of one's own."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any, Union

from . import _shearq

SubmissionLike = Union[str, "os.PathLike[str]", Mapping[str, Any], "Configuration"]


class Configuration:
    """How to get from a stamp to an ellipticity: all settings of a method, resolved.

    Attributes
    ----------
    name, description : str
        What it is called, and what it is.
    extends : str or None
        What it inherits from.
    settings : dict
        Every setting, section by section.
    toml : str
        The same as a settings file has them, for the command line.
    published : dict or None
        Published metrics: ``q``, ``m_half`` (M/2) and ``sqrt_a`` (√A in 10⁻⁴).
    stamp_size, psf_size : int
        Pixels a side of the piece of a stamp, and of a PSF stamp, that are used; of smaller PSF stamps all, where those do.
    psf_form : {'star', 'functional'}
        The PSFs that the command line gives it. Here, either serves.
    needs_noise : bool
        Whether the noise level has to be given; otherwise it is measured on all stamps, or on each one's border.
    ellipticity : {'shear', 'distortion'}
        The type of e1 and e2.
    """

    __slots__ = ("_resolved",)

    def __init__(self, resolved: _shearq.Configuration) -> None:
        self._resolved = resolved

    name = property(lambda self: self._resolved.name)
    description = property(lambda self: self._resolved.description)
    extends = property(lambda self: self._resolved.extends)
    toml = property(lambda self: self._resolved.toml)
    stamp_size = property(lambda self: self._resolved.sizes[0])
    psf_size = property(lambda self: self._resolved.sizes[1])
    psf_form = property(lambda self: "functional" if self._resolved.functional else "star")
    needs_noise = property(lambda self: self._resolved.needs_noise)
    ellipticity = property(lambda self: self._resolved.ellipticity)

    @property
    def settings(self) -> dict[str, Any]:
        return json.loads(self._resolved.settings)

    @property
    def published(self) -> dict[str, float] | None:
        metrics = self._resolved.published
        return None if metrics is None else dict(zip(("q", "m_half", "sqrt_a"), metrics))

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._resolved.parts,)

    def __repr__(self) -> str:
        return f"<shearq.Configuration {self.name!r}: {self.description}>"


def _restored(parts: tuple[str, str | None, tuple[float, float, float] | None]) -> Configuration:
    """The submission that pickle kept."""
    return Configuration(_shearq.Configuration.restored(parts))


def submission(of: SubmissionLike) -> Configuration:
    """Resolve a submission.

    Parameters
    ----------
    of : str, path, mapping or Configuration
        The name of an embedded submission such as ``"48/linear/star"``, the path of a settings file, the text
        of one (more than one line, or a single assignment), or settings as a mapping:
        ``{"extends": "48/linear/star", "noise": {"source": "border", "border": 4}}``.

    Returns
    -------
    Configuration

    Raises
    ------
    KeyError
        If no configuration or file has that name.
    ValueError
        Where a setting is unknown, of no use to the method, or out of range.
    """
    if isinstance(of, Configuration):
        return of
    if isinstance(of, Mapping):
        try:
            text = json.dumps(of, default=_plain, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"submission: settings that are none: {error}") from None
        return Configuration(_shearq.Configuration.json(text))
    if not isinstance(of, (str, os.PathLike)):
        raise TypeError(
            f"submission: found {type(of).__name__}; expected a name, a path, the text of a settings file or a mapping"
        )
    name = os.fspath(of)
    if not isinstance(name, str):
        raise TypeError("submission: found a path of bytes; expected one of text")
    if "\0" in name or any("\ud800" <= c <= "\udfff" for c in name):
        raise KeyError(f"submission: there is no configuration or file named {name!r}")
    if "\n" in name or "=" in name:
        return Configuration(_shearq.Configuration.text(name))
    return Configuration(_shearq.Configuration.named(name))


def submissions() -> dict[str, Configuration]:
    """The embedded submissions by name: those of the paper's Table 1 in its order, and the linear ones.

    Returns
    -------
    dict of str to Configuration

    Examples
    --------
    >>> shearq.submissions()["23/den/star"].published["q"]
    87.06
    """
    return {name: submission(name) for name in _shearq.names()}


def _plain(value: Any) -> Any:
    """Scalars of numpy as Python's."""
    if hasattr(value, "item"):
        return value.item()
    raise TypeError(f"{type(value).__name__} is no setting")
