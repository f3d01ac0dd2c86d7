"""The frame round the verbs: which errors are told, which are bugs; interruption; broken pipes."""

from __future__ import annotations

import argparse
import sys
import types
from importlib.metadata import EntryPoint

import pytest
from splatct_client import cli


@pytest.fixture
def verb(monkeypatch):
    """A verb of another distribution; the test says what it does."""
    module = types.ModuleType("tests_other_verb")
    module.HELP, module.configure = "does something", lambda parser: parser.add_argument("--speed", type=int)
    module.run = lambda args: 0
    monkeypatch.setitem(sys.modules, module.__name__, module)
    found = [EntryPoint("other", module.__name__, cli.GROUP), EntryPoint("gone", "no_such_module", cli.GROUP)]
    monkeypatch.setattr(cli, "entry_points", lambda group: found)
    return module


class SplatCTError(Exception):
    """As in the engine: a class of its own that shares only the name."""


class OptionsError(SplatCTError):
    pass


def raising(error):
    def run(args: argparse.Namespace) -> int:
        raise error

    return run


def test_the_exit_code_is_the_verbs(verb):
    verb.run = lambda args: args.speed
    assert cli.main(["other", "--speed", "7"]) == 7


def test_json_is_known_to_every_verb(verb):
    seen = []
    verb.run = lambda args: seen.append(args.json) or 0
    assert cli.main(["other", "--json"]) == cli.main(["other"]) == 0
    assert seen == [True, False]


def test_a_verb_may_declare_json_itself(verb):
    verb.configure = lambda parser: parser.add_argument("--json", action="store_true", help="says more")
    verb.run = lambda args: 7 if args.json else 8
    assert cli.main(["other", "--json"]) == 7


def test_an_error_on_purpose_is_told_in_one_line(verb, capsys):
    verb.run = raising(OptionsError("splats: got 3"))
    assert cli.main(["other"]) == 2
    assert capsys.readouterr() == ("", "splatct: splats: got 3\n")


def test_a_bug_keeps_its_traceback(verb):
    verb.run = raising(ValueError("a bug"))
    with pytest.raises(ValueError, match="a bug"):
        cli.main(["other"])


def test_a_full_disk_is_no_bug(verb, capsys):
    verb.run = raising(OSError(28, "No space left on device", "out/volume.tif"))
    assert cli.main(["other"]) == 1
    assert "out/volume.tif: No space left on device" in capsys.readouterr().err


def test_ctrl_c_is_130(verb, capsys):
    verb.run = raising(KeyboardInterrupt())
    assert cli.main(["other"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_verb_that_cannot_be_loaded_hides_no_other(verb, capsys):
    assert cli.main(["--help"]) == 0
    listed = capsys.readouterr().out
    assert "does something" in listed and "cannot be loaded: No module named 'no_such_module'" in listed
    assert cli.main(["gone"]) == 2
    assert "no_such_module" in capsys.readouterr().err
