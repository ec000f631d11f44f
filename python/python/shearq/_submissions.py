"""Named configurations, and those of one's own."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Mapping
from typing import Any, Literal, Union

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
        Pixels a side that are used of a stamp and of its PSF stamp. Of a smaller PSF stamp, all pixels are used, if the configuration allows it.
    psf_form : {'star', 'functional'}
        Which PSFs the command line reads for it. In Python, you give the PSF, and this has no effect.
    needs_noise : bool
        Whether the noise level has to be given; otherwise it is measured on all stamps, or on each one's border.
    ellipticity : {'shear', 'distortion'}
        The type of e1 and e2.
    """

    __slots__ = ("_extends", "_published", "_resolved", "_settings")

    def __init__(self, resolved: _shearq.Configuration) -> None:
        self._resolved = resolved
        settings, self._extends, self._published = resolved.parts
        self._settings: dict[str, Any] = json.loads(settings)

    @property
    def name(self) -> str:
        """What the configuration is called."""
        name: str = self._settings["name"]
        return name

    @property
    def description(self) -> str:
        """What it is."""
        description: str = self._settings["description"]
        return description

    @property
    def extends(self) -> str | None:
        """What it inherits from."""
        return self._extends

    @property
    def toml(self) -> str:
        """All settings as a settings file for the command line."""
        return self._resolved.toml

    @property
    def stamp_size(self) -> int:
        """Pixels per side of the part of a stamp that is used."""
        size: int = self._settings["stamp"]["size"]
        return size

    @property
    def psf_size(self) -> int:
        """Pixels per side of the part of a PSF stamp that is used."""
        size: int = self._settings["psf"]["size"]
        return size

    @property
    def psf_form(self) -> Literal["star", "functional"]:
        """The PSFs that the command line uses with it."""
        form: Literal["star", "functional"] = self._settings["psf"]["form"]
        return form

    @property
    def needs_noise(self) -> bool:
        """Whether the noise level must be given."""
        return bool(self._settings["noise"]["source"] == "header")

    @property
    def ellipticity(self) -> Literal["shear", "distortion"]:
        """The type of e1 and e2."""
        ellipticity: Literal["shear", "distortion"] = self._settings["shape"].get("ellipticity", "shear")
        return ellipticity

    @property
    def settings(self) -> dict[str, Any]:
        """All settings, section by section."""
        return copy.deepcopy(self._settings)

    @property
    def published(self) -> dict[str, float] | None:
        """Published metrics ``q``, ``m_half`` (M/2) and ``sqrt_a`` (√A in 10⁻⁴); None if there are none."""
        metrics = self._published
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
        The name of an embedded configuration such as ``"48/linear/star"``, the path of a settings file, the text
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
            raise ValueError(f"submission: not valid settings: {error}") from None
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
    """The embedded configurations by name: those of Table 1 of Nurbaeva et al. (2015) in its order, and the linear ones.

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
