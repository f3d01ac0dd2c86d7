"""The `splatct` command. Its verbs come from the installed distributions, through the entry-point
group `splatct.verbs`: a verb is a module with `HELP: str`, `configure(parser)` and
`run(args) -> int`. Only the chosen one is loaded.

Exit codes: 0 done; 1 the work failed; 2 wrong input or usage; 3 the server cannot be reached;
130 interrupted. With `--json`, stdout holds one JSON object, be it the result or
`{"error": {...}}`; messages for people and progress go to stderr.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import io
import json
import os
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from typing import Any, NoReturn

GROUP = "splatct.verbs"
WORK_FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130
BROKEN_PIPE = 141  # 128 + SIGPIPE, as a program killed by the signal would give
EPILOG = (
    "exit codes: 0 done, 1 the work failed, 2 wrong input or usage, 3 the server cannot be reached, 130 interrupted"
)


class _Parser(argparse.ArgumentParser):
    """argparse, but with --json a usage error is JSON as well."""

    as_json = False

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        _report("UsageError", message, USAGE_ERROR, self.as_json)
        raise SystemExit(USAGE_ERROR)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; the return value is the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name in Greek must not end a C-locale session
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `splatct jobs | head`
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:  # the disk is full, a file may not be read: no fault of the program
        _report(type(error).__name__, _os_text(error), WORK_FAILED, "--json" in arguments)
        return WORK_FAILED
    except Exception as error:
        if not raised_on_purpose(error):
            raise
        code = int(getattr(error, "exit_code", USAGE_ERROR))
        _report(type(error).__name__, str(error), code, "--json" in arguments, getattr(error, "problems", ()))
        return code


def raised_on_purpose(error: BaseException) -> bool:
    """Is its text meant for people? The engine's and the client's errors each have a base SplatCTError."""
    return any(base.__name__ == "SplatCTError" for base in type(error).__mro__)


def _os_text(error: OSError) -> str:
    return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)


def find_verbs() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name)}


def _dispatch(arguments: list[str]) -> int:
    verbs = find_verbs()
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        print(_overview(verbs))
        return 0
    if first in ("-V", "--version"):
        print(_versions())
        return 0
    if first not in verbs:
        _Parser.as_json = "--json" in arguments
        parser = _Parser(prog="splatct", usage="splatct VERB [OPTIONS]; `splatct --help` lists the verbs")
        close = difflib.get_close_matches(first, verbs, n=1)
        guess = f"; did you mean {close[0]!r}?" if close else ""
        parser.error(f"unknown verb {first!r}{guess}" if first else "which verb?")
    try:
        verb: Any = verbs[first].load()
    except ImportError as error:
        _report("ImportError", f"`splatct {first}` cannot be loaded: {error}", USAGE_ERROR, "--json" in arguments)
        return USAGE_ERROR
    parser = _Parser(prog=f"splatct {first}", description=verb.HELP, epilog=EPILOG)
    parser.as_json = "--json" in arguments
    verb.configure(parser)
    with contextlib.suppress(argparse.ArgumentError):  # a verb may declare it itself, to say more about it
        parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, errors too")
    return int(verb.run(parser.parse_args(arguments[1:])) or 0)


def _overview(verbs: dict[str, EntryPoint]) -> str:
    """The page of `splatct --help`: a verb that cannot be loaded says so and hides no other."""
    lines = [
        "usage: splatct VERB [OPTIONS]",
        "",
        "X-ray CT reconstruction that corrects the scan's geometry.",
        "",
        "verbs:",
    ]
    width = max((len(name) for name in verbs), default=0)
    for name, entry in verbs.items():
        try:
            text = str(entry.load().HELP)
        except (ImportError, AttributeError) as error:
            text = f"(cannot be loaded: {error})"
        lines.append(f"  {name:<{width}}  {text}")
    if not verbs:
        lines.append("  none found: is the package installed?")
    return "\n".join([*lines, "", "`splatct VERB --help` tells more about one of them.", EPILOG])


def _versions() -> str:
    lines = []
    for name in ("splatct-client", "splatct"):
        with contextlib.suppress(PackageNotFoundError):
            lines.append(f"{name} {version(name)}")
    return "\n".join(lines)


def _report(kind: str, message: str, code: int, as_json: bool, problems: Sequence[Any] = ()) -> None:
    print(f"splatct: {message}", file=sys.stderr)
    if as_json:
        error = {"kind": kind, "message": message, "exit_code": code}
        listed = [problem.to_json() if hasattr(problem, "to_json") else str(problem) for problem in problems]
        print(json.dumps({"error": {**error, "problems": listed}}, ensure_ascii=False))


if __name__ == "__main__":
    raise SystemExit(main())
