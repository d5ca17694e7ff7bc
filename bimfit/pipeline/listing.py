"""A model in, its joints out. Imports little, so that listing joints is quick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bimfit.config import JointConfig

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.bim.selection import Selection


def model_joints(
    path: Path, config: JointConfig, wanted: Selection | Sequence[str] = ()
) -> tuple[Model, tuple[Joint, ...]]:
    """Load a model and find its joints, or just those that are ``wanted``: by a selection, or by name.

    Raises
    ------
    ModelError
        When the model cannot be read or holds no joint.
    JointError
        When what is asked for does not exist.
    """
    from bimfit.bim.model import load_model
    from bimfit.bim.selection import choose_joints

    model = load_model(path)
    return model, choose_joints(model, wanted, config)
