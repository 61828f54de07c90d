"""The command line: `main` runs a command and turns every mistake in the input into one line and exit status 2."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import warnings
from collections.abc import Sequence

from imulab._version import VERSION

_INTERRUPTED, _INTERRUPTED_PIPE, _TERMINATED = 130, 141, 143  # 128 + the signal, as a shell reports it


class _TerminatedError(BaseException):
    """The process got a signal to end."""


def main(arguments: Sequence[str] | None = None, *, project: bool = True) -> int:
    """Run ``imulab`` with the given arguments (those of the process by default) and return the exit status.

    `project` says whether a project file counts.
    """
    if (sys.argv[1:] if arguments is None else list(arguments)) == ["--version"]:
        return _print_version()
    # Before NumPy is loaded: the matrices here are small, and threads for them cost more than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from imulab.cli.options import begin

        with begin(project=project):
            return _main(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except _TerminatedError:
        return _TERMINATED


def _print_version() -> int:
    """Print the version before anything is imported, because programs ask for it to see whether imulab is installed."""
    try:
        print(f"imulab {VERSION}", flush=True)
    except OSError as error:
        return _stop_writing(error)
    return 0


def _main(arguments: Sequence[str] | None) -> int:
    from imulab.cli.app import run, typed_words
    from imulab.cli.options import explained, release
    from imulab.errors import ImulabError

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal without µ gets a question mark, not a fault
            stream.reconfigure(errors="replace")
    try:
        if arguments is None and (asked := os.environ.get("_IMULAB_COMPLETE")):
            return _complete(asked)
        status = run(typed_words() if arguments is None else arguments)
        sys.stdout.flush()
        release()
    except ImulabError as error:
        return _refuse(explained(str(error)))
    except SystemExit as error:
        return 0 if not error.code else _stop_writing(BrokenPipeError())
    except OSError as error:
        return _stop_writing(error)
    except MemoryError as error:
        return _refuse(
            f"not enough memory ({error or 'for this much data at once'}): expected less data or smaller options"
        )
    except Exception as error:
        if os.environ.get("IMULAB_DEBUG"):
            raise
        print(
            f"imulab: internal error: {type(error).__name__}: {_one_line(str(error))} "
            "(a fault of imulab; IMULAB_DEBUG=1 shows where)",
            file=sys.stderr,
        )
        return 1
    return status or 0


def _complete(asked: str) -> int:
    """Print the completions of a word, or the shell's script for them."""
    from imulab.cli.app import ROOT_OPTIONS, find, listed_commands
    from imulab.cli.completion import answer

    text, status = answer(asked, find, listed_commands, ROOT_OPTIONS)
    print(text)
    sys.stdout.flush()
    return status


def _stop_writing(error: OSError) -> int:
    """Return the exit status of a command whose output has no reader any more, or cannot be written."""
    if isinstance(error, BrokenPipeError):  # the reader has gone; nothing more can be said there
        sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115
        return _INTERRUPTED_PIPE
    return _refuse(f"{error.filename or 'standard output'}: cannot be written: {error.strerror}")


def run() -> None:
    """Entry point of the installed command; a termination unwinds it, so that no part of a file stays behind."""
    signal.signal(signal.SIGTERM, _terminate)
    if os.name != "nt" and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # a closed terminal; nohup goes on
        signal.signal(signal.SIGHUP, _terminate)
    if not sys.warnoptions and not os.environ.get("IMULAB_DEBUG"):
        warnings.simplefilter("ignore")  # they name lines of sources, not what a person can mend
        sys.warnoptions.append("ignore")  # in the processes that are started, too
    closed = _open_closed()
    status = main()
    if "stdout" in closed:  # what could not be written is not tried again at the end, with a traceback
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if status == _INTERRUPTED:
        # Python ends by the signal itself, and not with this status, where an interrupt met the exec() of a text, as
        # dataclasses have it while they are imported, even though it was handled here.
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def _open_closed() -> set[str]:
    """Open substitutes for closed standard streams, which files opened later would replace; return their names.

    Input and output still refuse to be used, as closed ones do; what is said on standard error is lost.
    """
    closed = {name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None}
    for number, name, flags in ((0, "stdin", os.O_WRONLY), (1, "stdout", os.O_RDONLY), (2, "stderr", os.O_WRONLY)):
        if name in closed:
            taken = os.open(os.devnull, flags)
            if taken != number:
                os.dup2(taken, number)
                os.close(taken)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))
    return closed


def _terminate(number: int, frame: object) -> None:
    raise _TerminatedError


def _refuse(message: str) -> int:
    print(f"imulab: {_one_line(message)}", file=sys.stderr)
    return 2


def _one_line(text: str) -> str:
    from imulab.display import printable

    return printable(" ".join(text.split()))
