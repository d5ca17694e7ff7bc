"""Options that several commands share, given to a command as one argument."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any


def shared_options(
    command: Callable[..., int],
    argument: str,
    options: Mapping[str, tuple[Any, Any]],
    gather: Callable[..., Any],
    heading: str = "",
) -> Callable[..., int]:
    """Give a command more options, which it receives as one argument.

    Parameters
    ----------
    command : callable
        Takes ``argument`` beside its own parameters.
    argument : str
    options : mapping of str to (type, typer option)
        By parameter name.
    gather : callable
        Makes the argument of the options' values, given by name.
    heading : str
        What the options without one stand under on a help page.
    """
    for _, option in options.values():
        option.rich_help_panel = option.rich_help_panel or heading or None
    own = inspect.signature(command)
    # a command that already shares options has types for annotations, a plain one has strings; the shared
    # arguments' own types are only there for the type checker
    notes = command.__annotations__
    known = {
        name: eval(kind, command.__globals__) if isinstance(kind, str) else kind
        for name, kind in notes.items()
        if name not in (argument, "return") and (not isinstance(kind, str) or name not in _SHARED)
    }

    @functools.wraps(command)
    def run(**values: Any) -> int:
        picked = {name: values.pop(name) for name in options}
        return command(**{argument: gather(**picked)}, **values)

    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in options.items()
    ]
    kept = [
        parameter.replace(
            kind=inspect.Parameter.KEYWORD_ONLY, annotation=known.get(name, parameter.annotation)
        )
        for name, parameter in own.parameters.items()
        if name != argument
    ]
    signature = own.replace(parameters=[*kept, *added], return_annotation=int)
    run.__signature__ = signature  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in signature.parameters.values()} | {"return": int}
    del run.__wrapped__  # typer would look through it
    return run


_SHARED = ("choice", "where")
