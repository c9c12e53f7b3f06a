"""How the command leaves when it is stopped, when nobody reads on, and when its results have no place."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.ctrl_c import heeding_ctrl_c
from tests.toy_rigs import write_toy_rig
from udccal.cli import main as main_module
from udccal.errors import UdccalError
from udccal.io.out_folder import check_writable
from udccal.io.png import write_png16

COMMAND = [sys.executable, "-m", "udccal.cli.main"]
PORTRAIT = Path(__file__).resolve().parents[2] / "udccal" / "data" / "portrait.jpg"


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=280)


def interrupted(words: list[str | Path], sign: Path | None, wait_s: float) -> tuple[int, str, str]:
    """Press Ctrl-C some time after a file is there, or after the start; return status, output and errors."""
    with subprocess.Popen(
        [*COMMAND, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heeding_ctrl_c,
    ) as process:
        while sign is not None and not sign.exists():
            assert process.poll() is None
            time.sleep(0.002)
        time.sleep(wait_s)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=200)
    return process.returncode, out, err


# While verbs are imported, frames are captured, and a camera's threads end.
@pytest.mark.medium
@pytest.mark.parametrize(
    ("wait_s", "flags"), [(0.0, []), (0.01, ["--json"]), (0.03, []), (0.1, []), (0.25, []), (0.4, ["--json"])], ids=str
)
def test_ctrl_c_leaves_with_130_and_a_sentence(wait_s: float, flags: list[str], tmp_path: Path) -> None:
    words = ["calibrate", "--rig", write_toy_rig(tmp_path), "--session", tmp_path / "s", "--profile", tmp_path / "p"]
    status, out, err = interrupted([*words, *flags], tmp_path / "s" / "session.json", wait_s)
    assert status == 130, err
    assert err.strip().splitlines()[-1].startswith("udccal: Stopped. Run the same command again to continue")
    assert "Traceback" not in err
    if flags:
        assert json.loads(out)["error"].startswith("Stopped.")
    else:
        assert out == ""


@pytest.mark.parametrize("wait_s", [0.15, 0.3])
def test_ctrl_c_while_the_command_starts_is_met_with_a_sentence(wait_s: float) -> None:
    status, _, err = interrupted(["demo", "--out", "/dev/null/demo"], None, wait_s)
    assert status in (1, 130)  # on a quick machine the place is refused before
    assert err.startswith("udccal: ")
    assert "Traceback" not in err


@pytest.mark.parametrize(("verb", "kept"), [("calibrate", True), ("run", False), ("fit", False)])
def test_only_a_capture_is_said_to_keep_its_steps(
    verb: str, kept: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(given: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(main_module, "_run", interrupt)
    with pytest.raises(SystemExit) as left:
        main_module.main(["--json", verb])
    shown = capsys.readouterr()
    assert left.value.code == 130
    assert ("completed steps of a session are kept" in shown.err) is kept
    assert "Run the same command again" in shown.err


@pytest.mark.parametrize(
    "swallowed",
    [
        "exec('raise KeyboardInterrupt')",  # Python then ends by the signal, whatever the status is
        "Freed(); time.sleep(100)",  # Python prints it and goes on
    ],
    ids=["in text", "while freed"],
)
def test_ctrl_c_is_met_wherever_python_is(swallowed: str, tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        "import sys, time\n"
        "import udccal.cli.jobs.show as job\n"
        "from udccal.cli.main import main\n"
        "class Freed:\n"
        "    def __del__(self): raise KeyboardInterrupt\n"
        "def interrupted(*_):\n"
        f"    {swallowed}\n"
        "job.show_profile = interrupted\n"
        "main(['profile', 'show', 'anything'])\n"
    )
    command = [sys.executable, "-m", "program"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, preexec_fn=heeding_ctrl_c)
    assert done.returncode == 130
    (sentence,) = done.stderr.strip().splitlines()
    assert sentence.startswith("udccal: Stopped.")


def test_the_package_itself_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "udccal", "rig", "lists"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "Usage: udccal rig" in done.stderr


def test_an_output_of_few_letters_gets_what_it_can_show() -> None:
    words = [*COMMAND, "profile", "show", "lg55-reduced"]
    done = subprocess.run(words, capture_output=True, timeout=280, env={**os.environ, "PYTHONIOENCODING": "latin-1"})
    assert done.returncode == 0, done.stderr
    assert b"K_DN_per_e" in done.stdout


def test_an_error_does_not_steer_the_terminal(tmp_path: Path) -> None:
    done = udccal("profile", "show", tmp_path / "a\x1b[2Jb")
    assert done.returncode == 1
    assert "a?[2Jb" in done.stderr
    assert "\x1b" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a file that is always full")
@pytest.mark.parametrize("flags", [[], ["--json"]], ids=str)
def test_a_full_disk_behind_the_output_is_a_sentence(flags: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        words = [*COMMAND, "rig", "list", *flags]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, timeout=280)
    assert done.returncode == 1
    assert "No space left on device" in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words", [["profile", "show", "lg55-reduced"], ["profile", "show", "lg55-reduced", "--json"], ["--help"]], ids=str
)
def test_a_closed_pipe_leaves_quietly(words: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*COMMAND, *words], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=280)
    os.close(writer)
    assert done.returncode == 141
    assert not any(word in done.stderr for word in ("udccal:", "Traceback", "Exception", "Error"))


@pytest.mark.parametrize("seed", ["-1", "half"])
def test_a_seed_that_is_none_is_a_wrong_word(seed: str, tmp_path: Path) -> None:
    done = udccal("simulate", PORTRAIT, "--rig", "lg55-reduced", "--out", tmp_path / "o", "--seed", seed)
    assert done.returncode == 2
    assert "--seed" in done.stderr
    assert not (tmp_path / "o").exists()


@pytest.mark.medium
def test_results_without_a_place_are_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    mosaic = tmp_path / "frame.png"
    write_png16(mosaic, np.zeros((768, 1024), np.uint16))
    restore = ["restore", mosaic, "--profile", "lg55-reduced", "--exposure-s", "0.01"]
    for words in (restore, ["simulate", PORTRAIT, "--rig", "lg55-reduced"]):
        done = udccal(*words, "--out", tmp_path / "file" / "out")
        assert done.returncode == 1, done.stderr
        (sentence,) = done.stderr.strip().splitlines()  # and no stage has run
        assert sentence.startswith("udccal: Expected to write the results to")
        assert "Not a directory" in sentence
    (tmp_path / "out" / "frame.png").mkdir(parents=True)
    done = udccal(*restore, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "is taken" in done.stderr


def test_a_folder_that_can_be_written_to_is_left_as_it_was(tmp_path: Path) -> None:
    check_writable(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())
    (tmp_path / "round").symlink_to(tmp_path / "round")
    with pytest.raises(UdccalError, match="Expected to write the results"):
        check_writable(tmp_path / "round" / "out")
