"""Shell completion for zsh and fish: corrects click's completion after `--wall=` and of comma-separated names."""

from click.shell_completion import CompletionItem, FishComplete, ShellComplete, ZshComplete


class _OptionWords(ShellComplete):
    """Completion for a shell that treats --wall=r as one word; its completion must be --wall=rigid, not rigid.

    Bash needs no correction, because it splits a word at "=".
    """

    def get_completions(self, args: list[str], incomplete: str) -> list[CompletionItem]:
        """Prefix the completions of a value with the option."""
        completions = super().get_completions(args, incomplete)
        option, sign, _ = incomplete.partition("=")
        if sign and option.startswith("--"):
            for item in (item for item in completions if item.type == "plain"):
                item.value = f"{option}={item.value}"
        return completions


class Zsh(_OptionWords, ZshComplete):
    """Completion for zsh."""


class Fish(_OptionWords, FishComplete):
    """Completion for fish: click's fish script reads lines "type,value" and splits each line at its commas.

    A value may contain commas, as in P,period, so this script splits a line at its first comma only.
    """

    source_template = FishComplete.source_template.replace('string split ","', 'string split --max 1 ","')
