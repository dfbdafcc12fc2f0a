"""Separate off-specular, local diffuse and subsurface scattering reflectance, and relight them.

capture = reflectsep.load_capture("captures/wax")
separation = reflectsep.fit(capture)
picture = separation.relight(torch.tensor([0.3, 0.4, 0.3]))

Nothing heavy is imported before it is used.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reflectsep.pipeline import fit, load, load_capture
    from reflectsep.separation import Separation

__version__ = "0.1.0"
__all__ = ["Separation", "__version__", "fit", "load", "load_capture"]

_HOMES = {
    "load_capture": "reflectsep.pipeline",
    "load": "reflectsep.pipeline",
    "Separation": "reflectsep.separation",
}


class _FitPackage(ModuleType):
    """The subpackage `reflectsep.fit`, which may also be called: `reflectsep.fit(capture, ...)`."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run the whole method on a capture: see `reflectsep.pipeline.fit`."""
        return import_module("reflectsep.pipeline").fit(*args, **kwargs)


class _Package(ModuleType):
    """`fit` names a function of the public interface and a subpackage: whichever is imported first, it is both."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "fit" and type(value) is ModuleType:
            value.__class__ = _FitPackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "fit":
        return import_module("reflectsep.fit")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
