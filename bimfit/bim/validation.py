"""What ifcopenshell's validator says of a file that it did not say of another."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from bimfit.bim.opening import open_ifc


def new_messages(before: str | Path, after: str | Path, *, rules: bool = False) -> list[str]:
    """Messages that a file gives and the one that it was made from does not.

    Parameters
    ----------
    before, after : path
    rules : bool
        Whether the schema's own rules are checked, too; slow.

    Returns
    -------
    list of str
        As often as they are given more; empty where ``after`` is as valid as ``before``.

    Raises
    ------
    ModelError
        When a file cannot be read.
    """
    return sorted((_messages(after, rules) - _messages(before, rules)).elements())


def lost_ids(before: str | Path, after: str | Path) -> list[str]:
    """GlobalIds of a file that are not in the one that was made from it.

    Raises
    ------
    ModelError
        When a file cannot be read.
    """
    old, new = ({root.GlobalId for root in open_ifc(path).by_type("IfcRoot")} for path in (before, after))
    return sorted(old - new)


def _messages(path: str | Path, rules: bool) -> Counter[str]:
    import ifcopenshell.validate

    logger = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(open_ifc(path), logger, express_rules=rules)
    return Counter(str(statement.get("message", statement)) for statement in logger.statements)
