"""The skeleton of every body: its joints and their sides."""

import numpy as np

from ash.capture.dataset import Skeleton

SIDES = ("left", "right")


SIGNS = (1.0, -1.0)


JOINTS: tuple[tuple[str, str], ...] = (
    ("pelvis", ""),
    ("spine", "pelvis"),
    ("chest", "spine"),
    ("neck", "chest"),
    ("head", "neck"),
    *(
        (f"{name}_{side}", f"{parent}_{side}" if parent not in ("chest", "pelvis") else parent)
        for side in SIDES
        for name, parent in (
            ("clavicle", "chest"),
            ("upper_arm", "clavicle"),
            ("forearm", "upper_arm"),
            ("hand", "forearm"),
            ("thigh", "pelvis"),
            ("shin", "thigh"),
            ("foot", "shin"),
            ("toe", "foot"),
        )
    ),
)


def make_skeleton(heads: dict[str, np.ndarray]) -> Skeleton:
    """A skeleton of our 21 joints from the rest position of each head (metres)."""
    names = tuple(name for name, _ in JOINTS)
    parents = np.array([names.index(parent) if parent else -1 for _, parent in JOINTS])
    return Skeleton(names=names, parents=parents, heads=np.array([heads[name] for name in names], dtype=np.float64))
