"""Completion by zsh and fish, where click's own would be wrong: after `--wall=`, and of names apart by commas."""

from click.shell_completion import CompletionItem, FishComplete, ShellComplete, ZshComplete


class _WholeWords(ShellComplete):
    """A shell that takes --wall=r for one word, and so wants --wall=rigid back, where click says rigid.

    Bash parts words at "=" itself.
    """

    def get_completions(self, args: list[str], incomplete: str) -> list[CompletionItem]:
        """Put the option before what completes its value."""
        found = super().get_completions(args, incomplete)
        option, sign, _ = incomplete.partition("=")
        if sign and option.startswith("--"):
            for item in (item for item in found if item.type == "plain"):
                item.value = f"{option}={item.value}"
        return found


class Zsh(_WholeWords, ZshComplete):
    """Zsh."""


class Fish(_WholeWords, FishComplete):
    """Fish, which is told a kind and a name apart by a comma: the name may hold more of them, as in P,period."""

    source_template = FishComplete.source_template.replace('string split ","', 'string split --max 1 ","')
