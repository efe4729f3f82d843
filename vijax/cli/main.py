"""The command `vijax`: a group of subcommands, each imported on demand."""

from importlib import import_module

import click
from click.shell_completion import add_completion_class

from vijax.cli.completion import Fish, Zsh
from vijax.cli.process import run

add_completion_class(Zsh)
add_completion_class(Fish)

_PAGES = {
    "sweep": "sweep",
    "compare": "compare",
    "orbit-diagram": "orbit_diagram",
    "basins": "basins",
    "response": "response",
    "fit": "fit",
    "branch": "branch",
    "curves": "curves",
    "design": "design",
    "explore": "explore",
    "docs": "docs",
    "doctor": "doctor",
}


class Pages(click.Group):
    """The group of subcommands. Each is a module of `vijax.cli.commands` with a command object of the module's name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the subcommands in the order of help."""
        return list(_PAGES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a subcommand and return it; None if there is none of that name."""
        module = _PAGES.get(cmd_name)
        return None if module is None else getattr(import_module(f"vijax.cli.commands.{module}"), module)


@click.group(
    cls=Pages,
    invoke_without_command=True,
    epilog="`vijax sweep --help` has the options of a sweep, and lines to begin with. A shell completes options and "
    'choices after eval "$(_VIJAX_COMPLETE=bash_source vijax)"; likewise zsh_source, and fish_source for source.',
    context_settings={"max_content_width": 120},
)
@click.version_option(package_name="vijax", message="vijax %(version)s")
@click.pass_context
def vijax(ctx: click.Context) -> None:
    """Map, compare and design vibro-impact energy harvesters with soft and hard walls."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def main(arguments: list[str] | None = None) -> int:
    """Run `vijax` with these arguments, by default `sys.argv[1:]`, and return the exit code of `process.run`."""
    return run(vijax, arguments)
