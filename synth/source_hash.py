"""Which code makes captures: a capture made by other code is made again, never reused.

All of `synth` but its exports, perturbations and derived truth, and what defines a capture: `ash.capture`, `ash.files`.
"""

import hashlib
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ash.files import hash_sources, source_files

HERE = Path(__file__).parent
MAKERS = (HERE, HERE.parent / "ash" / "capture", HERE.parent / "ash" / "files.py")
NOT_HASHED = (HERE / "export", HERE / "perturbation", HERE / "truth")
PACKAGES = ("anny", "drjit", "mitsuba", "numpy", "pillow", "scipy")


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of what decides the bytes of a capture: our sources, and the versions of what they rely on."""
    versions = [f"{package} {_version(package)}" for package in PACKAGES]
    return hashlib.sha256("\n".join([source_version(), *versions]).encode()).hexdigest()[:16]


@lru_cache(maxsize=1)
def source_version() -> str:
    """Hash of our sources alone: equal on machines whose renders differ by rounding."""
    return hash_sources(*MAKERS, without=NOT_HASHED)[:16]


def maker_sources() -> list[Path]:
    """The files of source that decide the bytes of a capture."""
    return source_files(*MAKERS, without=NOT_HASHED)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"
