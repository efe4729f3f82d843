"""The paper's figures and its claims, recomputed.

    python scripts/paper --figure 8
    python scripts/paper --figure all --into figures
    python scripts/paper --claims

Figure N is written to figure_N.png in the folder; the claims are printed and written to claims.md there.
"""

import time
from pathlib import Path

import click

from vijax.cli import process

_STARTED = time.perf_counter()


def _options() -> list[click.Parameter]:
    return [
        click.Option(["--figure"], metavar="N", help="3 to 16, several with commas, or all"),
        click.Option(["--claims"], is_flag=True, help="the table of claims: the paper's values beside ours"),
        click.Option(["--into"], metavar="FOLDER", default=".", show_default=True, help="where files go"),
        click.Option(["--overwrite"], is_flag=True, help="replace what is there"),
    ]


@click.command(params=_options(), context_settings={"max_content_width": 120})
def paper(figure: str | None, claims: bool, into: str, overwrite: bool) -> None:
    """Draw figures of the paper, and check its claims."""
    with process.usage_errors():
        if figure is None and not claims:
            raise ValueError("figure must be given unless --claims is; got neither; try --figure 3")
        numbers = [] if figure is None else _numbers(figure)
        files = {number: _target(into, f"figure_{number}.png", overwrite) for number in numbers}
        table = _target(into, "claims.md", overwrite) if claims else None
    for number, file in files.items():
        _draw(number, file)
    if table is not None:
        _check(table)
    click.echo(f"{time.perf_counter() - _STARTED:.1f} s from start to end")


def _numbers(text: str) -> list[int]:
    from scripts.paper.captions import FIGURES

    if text == "all":
        return list(FIGURES)
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) in FIGURES for part in parts):
        raise ValueError(f"figure must be all, or among {', '.join(str(n) for n in FIGURES)}; got {text!r}")
    return [int(part) for part in parts]


def _target(folder: str, name: str, overwrite: bool) -> Path:
    from vijax.runtime.files import check_output

    return check_output("into", Path(folder) / name, overwrite)


def _draw(number: int, file: Path) -> None:
    from scripts.paper import figures
    from scripts.paper.captions import FIGURES

    start_time = time.perf_counter()
    figures.draw(number, file)
    click.echo(f"Fig. {number} in {time.perf_counter() - start_time:.1f} s, wrote {file}")
    if chosen := FIGURES[number].chosen:
        click.echo(f"  {chosen}")


def _check(file: Path) -> None:
    from scripts.paper import claims
    from vijax.runtime.files import replacing

    rows = []
    for claim in claims.CLAIMS.values():
        rows.append((claim, claim.check()))
        click.echo(claims.line(*rows[-1]))
    with replacing(file) as part:
        part.write_text(claims.markdown(rows), encoding="utf-8")
    click.echo(f"wrote {file}")


if __name__ == "__main__":
    process.command(lambda: process.run(paper))
