"""Completion of words in a shell, and its installation.

The names of environment variables and the forms of answers are those that earlier versions installed.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from imulab.cli.command import HELP, HELP_ALL, Command
from imulab.errors import OptionError, meant

ASKED = "_IMULAB_COMPLETE"
_SCRIPTS = {
    "bash": """\
_imulab_completion() {
    local IFS=$'\\n'
    COMPREPLY=( $( env COMP_WORDS="${COMP_WORDS[*]}" \\
                   COMP_CWORD=$COMP_CWORD \\
                   _IMULAB_COMPLETE=complete_bash $1 ) )
    return 0
}

complete -o default -F _imulab_completion imulab""",
    "zsh": """\
#compdef imulab

_imulab_completion() {
  eval $(env _TYPER_COMPLETE_ARGS="${words[1,$CURRENT]}" _IMULAB_COMPLETE=complete_zsh imulab)
}

compdef _imulab_completion imulab""",
    "fish": (
        'complete --command imulab --no-files --arguments "(env _IMULAB_COMPLETE=complete_fish '
        '_TYPER_COMPLETE_FISH_ACTION=get-args _TYPER_COMPLETE_ARGS=(commandline -cp) imulab)" --condition "env '
        "_IMULAB_COMPLETE=complete_fish _TYPER_COMPLETE_FISH_ACTION=is-args _TYPER_COMPLETE_ARGS=(commandline -cp) "
        'imulab"'
    ),
    "powershell": """\
Import-Module PSReadLine
Set-PSReadLineKeyHandler -Chord Tab -Function MenuComplete
$scriptblock = {
    param($wordToComplete, $commandAst, $cursorPosition)
    $Env:_IMULAB_COMPLETE = "complete_powershell"
    $Env:_TYPER_COMPLETE_ARGS = $commandAst.ToString()
    $Env:_TYPER_COMPLETE_WORD_TO_COMPLETE = $wordToComplete
    imulab | ForEach-Object {
        $commandArray = $_ -Split ":::"
        $command = $commandArray[0]
        $helpString = $commandArray[1]
        [System.Management.Automation.CompletionResult]::new(
            $command, $command, 'ParameterValue', $helpString)
    }
    $Env:_IMULAB_COMPLETE = ""
    $Env:_TYPER_COMPLETE_ARGS = ""
    $Env:_TYPER_COMPLETE_WORD_TO_COMPLETE = ""
}
Register-ArgumentCompleter -Native -CommandName imulab -ScriptBlock $scriptblock""",
}
_SCRIPTS["pwsh"] = _SCRIPTS["powershell"]


def script(shell: str) -> str:
    """Return the script with which a shell completes words.

    Raises
    ------
    OptionError
        It is a shell that cannot.
    """
    if shell not in _SCRIPTS:
        raise OptionError(f"shell {shell or 'unknown'}: expected one of {' '.join(_SCRIPTS)}{meant(_SCRIPTS, shell)}")
    return _SCRIPTS[shell]


def install(shell: str) -> Path:
    """Install completion for a shell, and return the file that was changed; errors as for `script`."""
    text, home = script(shell), Path.home()
    if shell == "bash":
        path = home / ".bash_completions" / "imulab.sh"
        _add(home / ".bashrc", f"source '{path}'")
    elif shell == "zsh":
        path = home / ".zfunc" / "_imulab"
        _add(home / ".zshrc", "fpath+=~/.zfunc; autoload -Uz compinit; compinit")
        _add(home / ".zshrc", "zstyle ':completion:*' menu select", unless="zstyle")
    elif shell == "fish":
        path = home / ".config" / "fish" / "completions" / "imulab.fish"
    else:
        subprocess.run([shell, "-Command", "Set-ExecutionPolicy", "Unrestricted", "-Scope", "CurrentUser"], check=False)
        asked = subprocess.run([shell, "-NoProfile", "-Command", "echo", "$profile"], check=True, capture_output=True)
        path = Path(asked.stdout.decode(errors="replace").strip())
        text = (path.read_text(encoding="utf-8") if path.is_file() else "") + text
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n", encoding="utf-8")
    return path


def _add(path: Path, line: str, unless: str | None = None) -> None:
    """Add a line to a file that a shell runs at its start, unless it is there."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if (unless or line) not in text:
        path.write_text(f"{text.rstrip()}\n{line}\n".lstrip(), encoding="utf-8")


def current_shell() -> str:
    """Return the name of the shell that runs this process, empty where that is unknown."""
    import shellingham

    try:
        return str(shellingham.detect_shell()[0])
    except shellingham.ShellDetectionFailure:
        return ""


def answer(
    asked: str,
    find: Callable[[list[str]], Command | str],
    listed: Callable[[str], Iterable[tuple[str, str]]],
    options: Sequence[tuple[str, str]],
) -> tuple[str, int]:
    """Return the answer to a shell, and the exit status, from the instruction and the variables that it set.

    `find` takes whole words to the command that they begin with, or to the group that they name; `listed` a group to
    its commands and a line on each; `options` are those of the root.
    """
    instruction, _, shell = asked.partition("_")
    if instruction == "source":
        return script(shell), 0
    script(shell)
    words, incomplete = _typed(shell)
    place = find(words)
    if isinstance(place, Command):
        completions = _complete_word(place, words[len(place.name) :], incomplete)
    elif incomplete.startswith("-"):
        known = [*([] if place else options), *((flag, HELP.help) for flag in HELP.flags)]
        completions = (each for each in known if each[0].startswith(incomplete))
    else:
        completions = (each for each in listed(place) if each[0].startswith(incomplete))
    matching = [(word, " ".join(text.split())) for word, text in completions]
    if shell == "fish" and os.environ.get("_TYPER_COMPLETE_FISH_ACTION") != "get-args":
        return "", 0 if matching else 1
    if shell == "zsh":
        rows = [f'"{_escaped(word)}"' + (f':"{_escaped(text)}"' if text else "") for word, text in matching]
        return ("_arguments '*: :((" + "\n".join(rows) + "))'" if rows else "_files"), 0
    separator = {"bash": None, "fish": "\t"}.get(shell, ":::")
    rows = [word if separator is None or not text else f"{word}{separator}{text}" for word, text in matching]
    return "\n".join(rows if shell in ("bash", "fish") else [row if ":::" in row else f"{row}::: " for row in rows]), 0


def _escaped(text: str) -> str:
    for character, escaped in (('"', '""'), ("'", "''"), ("$", "\\$"), ("`", "\\`"), (":", r"\\:")):
        text = text.replace(character, escaped)
    return text


def _typed(shell: str) -> tuple[list[str], str]:
    """Return the whole words after ``imulab``, and the word that is being typed."""
    if shell == "bash":
        words, index = _split(os.environ["COMP_WORDS"]), int(os.environ["COMP_CWORD"])
        return words[1:index], words[index] if index < len(words) else ""
    line = os.environ.get("_TYPER_COMPLETE_ARGS", "")
    words = _split(line)[1:]
    if shell in ("powershell", "pwsh"):
        incomplete = os.environ.get("_TYPER_COMPLETE_WORD_TO_COMPLETE", "")
        return words[:-1] if incomplete else words, incomplete
    return (words[:-1], words[-1]) if words and not line.endswith(" ") else (words, "")


def _split(line: str) -> list[str]:
    """Return the words of a line; the last one may have an open quotation mark."""
    lexer = shlex.shlex(line, posix=True)
    lexer.whitespace_split, lexer.commenters = True, ""
    words: list[str] = []
    try:
        words.extend(lexer)
    except ValueError:
        words.append(lexer.token)
    return words


def _complete_word(command: Command, words: list[str], incomplete: str) -> Iterator[tuple[str, str]]:
    """Yield the completions of a word after a command, with their meanings."""
    if incomplete == "=":
        incomplete = ""
    elif incomplete.startswith("-") and "=" in incomplete:
        flag, _, incomplete = incomplete.partition("=")
        words = [*words, flag]
    if incomplete.startswith("-") and "--" not in words:
        for each in (*command.options, HELP, HELP_ALL):
            for flag in filter(None, (*each.flags, each.opposite)):
                if flag.startswith(incomplete) and (each.kind == "texts" or not {*each.flags} & {*words}):
                    yield flag, each.help
        return
    for each in command.options:
        if words and each.takes_value and words[-1] in each.flags:
            yield from ((word, "") for word in each.words if word.startswith(incomplete))
