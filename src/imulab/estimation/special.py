"""The distributions of statistics, from the compiled module of scipy that holds them.

``import scipy.special`` takes 0.2 s of processor time, more than most commands have to do: it describes each function
for other array libraries, and loads numpy's tools for testing and for Fortran on the way. The compiled functions inside
take 0.03 s. So only these are loaded here; the package itself runs as soon as somebody asks it for anything else.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from threading import RLock
from types import ModuleType
from typing import Any

_PACKAGE = "scipy.special"
_RUNNING = RLock()


class _Package(ModuleType):
    """A package whose own file runs when something is first asked of it that no module in it has set."""

    _to_run = True

    def __getattr__(self, name: str) -> Any:
        with _RUNNING:
            if self._to_run and self.__spec__ and self.__spec__.loader:
                self._to_run = False
                self.__spec__.loader.exec_module(self)
            if name in self.__dict__:
                return self.__dict__[name]
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")


def _functions() -> ModuleType:
    if _PACKAGE not in sys.modules and (found := find_spec(_PACKAGE)):
        package = module_from_spec(found)
        package.__class__ = _Package
        sys.modules[_PACKAGE] = package
        try:
            return import_module(f"{_PACKAGE}._ufuncs")
        except ImportError:  # another release of scipy may keep them elsewhere
            del sys.modules[_PACKAGE]
    return import_module(_PACKAGE)


_HELD = _functions()
chdtrc, chdtri, fdtrc, fdtri = _HELD.chdtrc, _HELD.chdtri, _HELD.fdtrc, _HELD.fdtri
ndtr, ndtri, stdtr, stdtrit = _HELD.ndtr, _HELD.ndtri, _HELD.stdtr, _HELD.stdtrit
sici = _HELD.sici
