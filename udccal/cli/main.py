"""The command ``udccal``: runs a verb, and leaves with a status and a sentence, whatever happens."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress

from udccal.cli.shown_text import shown
from udccal.errors import UdccalError

_GLOBAL_FLAGS = ("--json", "--debug")
_FAILED, _WORDS, _BUG = 1, 2, 70
# The statuses that a shell gives to programs which ended by SIGINT and by SIGPIPE.
_STOPPED, _PIPE_CLOSED = 130, 141
_CONTINUE = "Stopped. Run the same command again to continue; completed steps of a session are kept."
_BEGIN = "Stopped. Run the same command again to begin anew."
_CAPTURING = ("calibrate", "check", "demo", "simulate")
_REPORT = "Something unexpected went wrong ({}). Run the same command with --debug and report what it prints."


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit with its status, which docs/cli.md explains: 0, 1, 2, 3, 70, 130 or 141."""
    # Silences XLA's own log before JAX is imported: whatever matters in it also comes as an exception. A program that
    # has imported JAX hands its default, 1, to its children: 2 kB for every kept compilation, which fill a pipe.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    given = list(sys.argv[1:] if arguments is None else arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal or file of few letters gets question marks for the rest
    try:
        try:
            _run(given)
        finally:
            sys.stdout.flush()  # a full disk or a closed pipe shows here, and not when Python ends
    except UdccalError as error:
        _fail(str(error), _FAILED, given)
    except BrokenPipeError:
        _leave_the_rest()
        sys.exit(_PIPE_CLOSED)
    except OSError as error:
        try:
            sys.stdout.flush()
        except OSError:  # it is standard output that fails
            _leave_the_rest()
        place = str(error.filename)[:200] if error.filename else "what was asked for"
        found = f"Expected to read or write {place}, found: {error.strerror or error}."
        _fail(f"{found} Correct that place, or give another.", _FAILED, given)
    except KeyboardInterrupt:
        _fail(_stopped(given), _STOPPED, given)
    except SystemExit as left:  # typer turns Ctrl-C and a closed pipe into this, without a word
        if left.code == _WORDS and left.__context__ is not None:
            _answer_error(_sentence_of(left.__context__), given)
        if left.code == _STOPPED:
            _fail(_stopped(given), _STOPPED, given)
        if isinstance(left.__context__, BrokenPipeError):
            _leave_the_rest()
            sys.exit(_PIPE_CLOSED)
        raise
    except Exception as error:
        _fail(_REPORT.format(type(error).__name__), _BUG, given)


def _stopped(given: list[str]) -> str:
    """What to do after an interrupt: the first word that is no flag is the verb."""
    verb = next((word for word in given if not word.startswith("-")), "")
    return _CONTINUE if verb in _CAPTURING else _BEGIN


def _run(given: list[str]) -> None:
    """Run the verb; what it needs is loaded only here, where an interrupt is met with a sentence."""
    sys.unraisablehook = _stop_again
    from udccal.cli.app import app

    flags = [flag for flag in _GLOBAL_FLAGS if flag in given]
    app(args=[*flags, *(word for word in given if word not in flags)], prog_name="udccal")


def _stop_again(lost: sys.UnraisableHookArgs) -> None:
    """Stop the program a moment later where Python has swallowed Ctrl-C, as it does while an object is freed."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    import signal
    import threading

    # A signal to this very thread ends what it waits for; ``interrupt_main`` would be met only after that.
    threading.Timer(0.01, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)).start()


def _leave_the_rest() -> None:
    """Let what is still buffered for standard output go nowhere; else Python would complain when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _sentence_of(error: BaseException) -> str:
    """What click says of words that it refuses; it has printed that on standard error."""
    return error.format_message() if hasattr(error, "format_message") else str(error)


def _answer_error(sentence: str, given: list[str]) -> None:
    """Print the object that a program reads where it asked for one."""
    if "--json" in given or "--json-events" in given:
        import json

        with suppress(OSError):  # standard output may be what failed
            print(json.dumps({"error": sentence}), flush=True)


def _fail(sentence: str, status: int, given: list[str]) -> None:
    """Print one sentence on standard error, with ``--debug`` the traceback before it; exit with a non-zero status."""
    if "--debug" in given:
        import traceback

        traceback.print_exc()
    _answer_error(sentence, given)
    print(f"udccal: {shown(' '.join(sentence.split()))}", file=sys.stderr, flush=True)
    # An interrupt while Python runs text, as it does to make a dataclass, marks the process as ended by the signal,
    # even where it was caught. Running text once more takes the mark back: the status is the one given here.
    exec("")
    sys.exit(status)


if __name__ == "__main__":
    main()
