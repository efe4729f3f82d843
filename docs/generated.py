"""Parts of pages that are generated from the tables of the program and the stored rows of benchmarks."""

from pathlib import Path

import click

from docs import measured
from docs.markdown import escaped, table
from vijax.cli.main import vijax as command
from vijax.cli.page import Page
from vijax.maps import outputs
from vijax.maps.outputs import ON_REQUEST
from vijax.model.quantities import AXES, QUANTITIES
from vijax.model.records import Status

INTO = Path(__file__).parent / "generated"


def write() -> None:
    """Write the parts into `generated`; an unchanged file is not written, so that Sphinx does not rebuild its page."""
    INTO.mkdir(exist_ok=True)
    texts = {"command": _command(), "status": _status(), "quantities": _quantities()}
    texts |= {"outputs": _outputs(1), "outputs_expected": _outputs(2)}
    for name, text in (texts | measured.texts()).items():
        path = INTO / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    measured.draw(INTO)


def _command() -> str:
    context = click.Context(command, info_name="vijax")
    return "\n".join(_page(name, context) for name in command.list_commands(context))


def _page(name: str, above: click.Context) -> str:
    page = command.get_command(above, name)
    assert page is not None, name
    context = click.Context(page, info_name=name, parent=above)
    parts = [f"## vijax {name}\n", page.help or "", ""]
    if isinstance(page, Page):
        for title, options in page.sections.items():
            records = [record for option in options if (record := option.get_help_record(context))]
            parts += [f"**{title}**\n", table(("option", "meaning"), [(f"`{a}`", escaped(b)) for a, b in records])]
        parts += [escaped(page.epilog or ""), "", "Lines to begin with:\n", "```sh"]
        parts += [f"vijax {name} {example}".rstrip() for example in page.examples] + ["```", ""]
    return "\n".join(parts)


def _outputs(starts: int) -> str:
    rows = [
        (f"`{name}`", output.units, escaped(output.description) + (" (on request)" if name in ON_REQUEST else ""))
        for name, output in outputs.available_outputs(starts).items()
    ]
    return table(("variable", "unit", "what it is"), rows)


def _status() -> str:
    rows = [(str(int(status)), f"`{status.name.lower()}`", escaped(status.advice)) for status in Status]
    return table(("value", "name", "what to do"), rows)


def _quantities() -> str:
    from vijax.model.device import Harvester

    device = Harvester()
    rows = []
    for name, quantity in QUANTITIES.items():
        default = quantity.default if name in AXES else _default(getattr(device, name))
        rows.append((f"`{name}`", quantity.unit or "1", escaped(quantity.long_name), default, quantity.rule.must))
    return table(("name", "unit", "what it is", "unless given", "values"), rows)


def _default(value: float | None) -> str:
    return "the radius R0" if value is None else f"{value:.6g}"
