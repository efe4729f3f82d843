"""A subcommand with sections of options in its help, and examples at the end."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import click

Sections = Mapping[str, Sequence[click.Parameter]]
"""Options by section title of help."""


class ConstantOption(click.Option):
    """An option for one constant of the device: `--energy-ratio-limit 0.1` means `--set energy_ratio_limit=0.1`."""


class Page(click.Command):
    """A subcommand of `vijax`, or a script.

    Attributes:
        sections: Options by title, in the order of help.
        examples: Argument lines, shown at the end of help.
    """

    def __init__(
        self, name: str, callback: Callable[..., None], sections: Sections, examples: Sequence[str], epilog: str
    ) -> None:
        """Take the options from the sections, and the description from the docstring of the callback."""
        self.sections, self.examples = sections, examples
        super().__init__(
            name,
            context_settings={"max_content_width": 120},
            callback=callback,
            params=[option for options in sections.values() for option in options],
            help=inspect.getdoc(callback),
            epilog=epilog,
        )

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, with values of `ConstantOption` added to the constants of --set."""
        for option in self.params:
            if isinstance(option, ConstantOption) and (value := ctx.params.pop(str(option.name))) is not None:
                ctx.params["constants"] += (f"{option.name}={value}",)
        return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one section of options per title; the option --help is added to the last section."""
        records = {title: list(_records(options, ctx)) for title, options in self.sections.items()}
        records[next(reversed(records))].extend(_records([self.get_help_option(ctx)], ctx))
        # The help texts of all sections start in one column.
        width = max(len(names) for rows in records.values() for names, _ in rows)
        for title, rows in records.items():
            with formatter.section(title):
                formatter.write_dl([(names.ljust(width), text) for names, text in rows], col_max=width)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog, then the examples; every example is one line that is not wrapped."""
        super().format_epilog(ctx, formatter)
        with formatter.section("Examples"):
            for arguments in self.examples:
                formatter.write(" " * formatter.current_indent + f"{ctx.command_path} {arguments}".rstrip() + "\n")


def _records(options: Sequence[click.Parameter | None], ctx: click.Context) -> Iterator[tuple[str, str]]:
    for option in options:
        if option is not None and (record := option.get_help_record(ctx)) is not None:
            yield record
