"""Help pages with their options in groups."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

METHOD = "Method"
SLICES = "Slices and sensor"
WRITTEN = "What is written"


class GroupedCommand(TyperCommand):
    """A command whose help lists options under the heading that each has as its ``rich_help_panel``.

    In plain text: it stays whole in a narrow terminal, and can be searched.
    """

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options without a heading, then each heading's options, in their order."""
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is None:
                continue
            own = "Arguments" if param.param_type_name == "argument" else "Options"
            groups.setdefault(getattr(param, "rich_help_panel", None) or own, []).append(record)
        for heading, records in groups.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)
