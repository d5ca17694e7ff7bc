"""A model in, its joints out. Imports little, so that listing joints is quick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bimfit.config import JointConfig
from bimfit.errors import JointError

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model


def model_joints(
    path: Path, config: JointConfig, wanted: Sequence[str] = ()
) -> tuple[Model, tuple[Joint, ...]]:
    """Load a model and find its joints, or just those that are ``wanted`` by id or ``GUID,GUID``.

    Raises
    ------
    ModelError
        When the model cannot be read or holds no joint.
    JointError
        When a joint that is asked for does not exist.
    """
    from bimfit.bim.joints import find_joints, no_joint_reason, select_joints
    from bimfit.bim.model import load_model

    model = load_model(path)
    joints = select_joints(model, wanted, config) if wanted else find_joints(model, config)
    if not joints:
        raise JointError(
            f"no joint found: {no_joint_reason(model, config)}",
            file=path,
            remedy="name the pair with --joint GUID,GUID or widen --max-gap",
        )
    return model, joints
