import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

import factories
from foretrace import cli
from foretrace.evaluation.storage import read_rows
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset


def fake_simulate(trials):
    return [factories.fake_lever_up(one.obj, one.action, id=one.id, seed=one.seed) for one in trials]


@pytest.fixture
def fake_physics(monkeypatch):
    monkeypatch.setattr("foretrace.simulation.lever_up.simulate_trials", fake_simulate)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    """What `folder` copies."""
    folder = tmp_path_factory.mktemp("cli") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("foretrace.simulation.lever_up.simulate_trials", fake_simulate)
        assert cli.main(["simulate", "--out", str(folder), "--objects", "8", "--workers", "1"]) == 0
    return folder


@pytest.fixture
def folder(fake_physics, simulated, tmp_path) -> Path:
    return shutil.copytree(simulated, tmp_path / "data")


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def test_simulate_writes_a_data_set_and_says_where(fake_physics, tmp_path, capsys):
    folder = tmp_path / "data"
    assert cli.main(["simulate", "--out", str(folder), "--objects", "8", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "levered     104  100.0 %" in printed
    assert printed.splitlines()[-1] == f"data set: {folder}"
    dataset = Dataset.open(folder)
    assert len(dataset) == 104
    assert dataset.manifest["configuration"]["simulation"]["embodiment"] == "arm"


def test_options_reach_the_configuration(fake_physics, tmp_path):
    options = ["--objects", "2", "--contacts-per-edge", "1", "--seed", "7", "--embodiment", "tool"]
    assert cli.main(["simulate", "--out", str(tmp_path), "--workers", "1", *options]) == 0
    configuration = storage.read_manifest(tmp_path)["configuration"]
    assert configuration["objects"] == 2
    assert configuration["contacts_per_edge"] == 1
    assert configuration["seed"] == 7
    assert configuration["simulation"]["embodiment"] == "tool"
    assert configuration["simulation"]["engine"] == "mujoco"
    assert len(Dataset.open(tmp_path)) == 7


def test_an_error_is_one_line_and_exit_status_2(folder, capsys):
    capsys.readouterr()
    assert cli.main(["simulate", "--out", str(folder), "--objects", "9"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("foretrace: error: ")
    assert printed.err.count("\n") == 1
    assert "objects = 8" in printed.err
    assert cli.main(["data", str(folder / "nowhere")]) == 2
    assert "no data set at" in capsys.readouterr().err


def test_simulate_takes_recipes_and_watches_solids_longer(fake_physics, tmp_path, capsys):
    begun = ["simulate", "--workers", "1", "--objects", "5", "--out"]
    assert cli.main([*begun, str(tmp_path / "mixed"), "--recipe", "mixed", "--table-edge", "0.3"]) == 0
    configuration = storage.read_manifest(tmp_path / "mixed")["configuration"]
    assert configuration["recipe"] == "mixed"
    assert configuration["simulation"]["watch_time"] == 1.5
    assert configuration["simulation"]["physics"]["table_edge"] == 0.3
    assert cli.main(["data", str(tmp_path / "mixed")]) == 0
    assert re.search(r"cylinder +8: 8 levered", capsys.readouterr().out)
    assert cli.main([*begun, str(tmp_path / "paper")]) == 0
    assert storage.read_manifest(tmp_path / "paper")["configuration"]["simulation"]["watch_time"] == 0
    capsys.readouterr()
    for wrong in (["--table-edge", "-0.1"], ["--watch-time", "1000"]):
        assert cli.main([*begun, str(tmp_path / "wrong"), "--recipe", "solids", *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_doctor_finds_repairs_and_tells_by_its_exit_status(folder, capsys):
    assert cli.main(["data", str(folder)]) == 0
    assert "104 interactions, no problems left" in capsys.readouterr().out
    (folder / storage.shard_name(1)).write_bytes(b"not parquet")
    assert cli.main(["data", str(folder)]) == 1
    assert f"found: {storage.shard_name(1)}: shard" in capsys.readouterr().out
    assert cli.main(["data", str(folder), "--repair"]) == 1
    printed = capsys.readouterr().out
    assert "repaired: " in printed
    assert "100 interactions, 1 problem left" in printed
    assert cli.main(["simulate", "--out", str(folder), "--objects", "8", "--workers", "1"]) == 0
    assert cli.main(["data", str(folder)]) == 0


def test_a_warning_is_one_line(folder, capsys):
    manifest = storage.read_manifest(folder)
    del manifest["shards"][storage.shard_name(1)]
    storage.write_manifest(folder, manifest)
    capsys.readouterr()
    assert cli.main(["show", str(folder), "--id", "3", "--out", str(folder / "one.svg")]) == 0
    printed = capsys.readouterr().err
    assert printed.startswith(f"foretrace: warning: {folder} is not finished: 1 of 2 shards are missing")
    assert printed.count("\n") == 1


def test_show_draws_sheet_picture_and_animation(folder, capsys):
    capsys.readouterr()
    assert cli.main(["show", str(folder)]) == 0
    assert capsys.readouterr().out == f"{folder}/figures/contact-sheet.png\n"
    assert cli.main(["show", str(folder), "--id", "3", "--out", str(folder / "deep" / "one.svg")]) == 0
    assert (folder / "deep" / "one.svg").stat().st_size > 1000
    assert (folder / "figures" / "contact-sheet.png").stat().st_size > 1000


def test_show_refuses_what_it_cannot_draw(folder, capsys):
    assert cli.main(["show", str(folder), "--out", "sheet.doc"]) == 2
    assert "sheet.doc: choose a name that ends in .png" in capsys.readouterr().err
    assert cli.main(["show", str(folder), "--out", "sheet.gif"]) == 2
    assert "choose the interaction with --id" in capsys.readouterr().err
    assert cli.main(["show", str(folder), "--id", "104"]) == 2
    assert "no interaction 104" in capsys.readouterr().err


@pytest.mark.slow
def test_evaluate_goes_on_and_prints_what_it_found(folder, tmp_path, capsys):
    out = tmp_path / "results"
    command = f"evaluate paper --data {folder} --out {out} --proportional --workers 1".split()
    command += ["--experiments", "support-points", "support-points-plain", "--settings", "50", "100"]
    command += ["--features", "chance", "sp-rule"]
    capsys.readouterr()
    assert cli.main([*command, "--seeds", "0", "1", "--dry-run"]) == 0
    assert capsys.readouterr().out.split() == [
        *("support-points", "8", "trials", "missing"),
        *("support-points-plain", "2", "trials", "missing"),
    ]
    assert not out.exists()
    assert cli.main([*command, "--seeds", "0"]) == 0
    assert cli.main([*command, "--seeds", "0", "1", "--dry-run"]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[-2:]] == ["4", "1"]
    assert cli.main([*command, "--seeds", "0", "1"]) == 0
    printed = capsys.readouterr()
    assert "5 of 10 trials are there already" in printed.err
    assert "support-points: share with both support points right" in printed.out
    table = read_rows(out)
    rows = table[
        (table["metric"] == "accuracy") & (table["features"] == "chance") & (table["setting"] == "100")
    ]
    assert f"{rows[rows['experiment'] == 'support-points']['value'].mean():.3f} (2)" in printed.out
    assert str(out / "summary.json") in printed.out.splitlines()
    assert cli.main([*command, "--epochs", "2"]) == 2
    assert "epochs = 15, asked for is 2" in capsys.readouterr().err


def test_evaluate_reports_trials_that_failed(fake_physics, tmp_path, capsys):
    folder, out = tmp_path / "data", tmp_path / "results"
    assert cli.main(["simulate", "--out", str(folder), "--objects", "5", "--workers", "1"]) == 0
    command = f"evaluate paper --data {folder} --out {out} --proportional --seeds 0 --workers 1".split()
    command += ["--experiments", "support-points-novel", "--features", "chance"]
    assert cli.main(command) == 1
    printed = capsys.readouterr().err
    assert (
        "failed: experiment support-points-novel, features chance, seed 0, setting 9&10: no object has"
        in printed
    )
    assert set(read_rows(out)["setting"]) == {"3&4", "5&6"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--features", "sift"], "features 'sift' is unknown: choose from sp-pred"),
        (["--experiments", "all"], "experiment 'all' is unknown: choose from support-points"),
        (["--settings", "7"], "setting '7' is unknown"),
        (["--seeds", "-1"], "seed -1 is negative"),
        ([], "104 levered interactions, the paper's comparisons need 1800"),
        (["--proportional", "--workers", "0"], "workers is 0"),
    ],
)
def test_evaluate_paper_refuses_in_one_line(options, message, folder, tmp_path, capsys):
    command = ["evaluate", "paper", "--data", str(folder), "--out", str(tmp_path / "results"), *options]
    capsys.readouterr()
    assert cli.main(command) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "results").exists()


def all_commands(entries: Mapping[str, cli.Entry] = cli.COMMANDS, above: tuple[str, ...] = ()):
    """Words of every command and of every group of them."""
    yield above
    for name, entry in entries.items():
        yield from (
            all_commands(entry.members, (*above, name)) if isinstance(entry, cli.Group) else [(*above, name)]
        )


VARIANTS = [("train", "--predictor", "one-shot"), ("train", "--features", "ae-256")]


@pytest.mark.parametrize("words", [*all_commands(), *VARIANTS], ids=" ".join)
def test_help_is_plain_and_fits_a_narrow_terminal(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with contextlib.suppress(SystemExit):
        assert cli.main([*words, "--help"]) == 0
    usage, *lines = capsys.readouterr().out.splitlines()
    assert usage.startswith(f"usage: foretrace {' '.join(words[:1])}".rstrip())
    assert max(map(len, lines)) <= 80
    text = " ".join(lines)
    for odd in ("{None}", "None|", "|None", "(default: None)", "(default: )", "``", "Args:", "partial("):
        assert odd not in text, odd
    # An option without a word about it is told from its neighbour by what follows on its line or the next one.
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("│ --"):
            bare = re.fullmatch(r"│ (--\S+)( [A-Z{][^a-z]*| \{\S+\})? *│", line) is not None
            assert not bare or not following.startswith("│ --"), line


def test_the_list_of_commands_has_a_line_for_each(capsys):
    assert cli.main(["--help"]) == 0
    printed = capsys.readouterr().out
    listed = re.findall(r"^  (\S+) +\S.*$", printed, re.MULTILINE)
    assert listed == list(cli.COMMANDS)
    assert len(listed) == 23
    assert cli.main([]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["levitate"], "unknown command 'levitate': choose from demo, simulate, data, data-merge"),
        (["simulat"], "unknown command 'simulat': did you mean simulate?"),
        (["export", "rosbags"], "did you mean rosbag?"),
        (["train", "--predictor", "gru"], "unknown predictor 'gru'; available: lstm, one-shot"),
        (["train", "--data", "d", "--out", "o", "--epochs", "0"], "epochs is 0"),
        (["simulate", "--out", "o", "--object", "3"], "perhaps --objects INT is meant"),
        (["train", "--data", "d", "--out", "o", "--state", "poses"], "one of ('position', 'pose', 'turn')"),
        (["simulate", "--out", "o", "--density", "1e-30"], "density = 1e-30"),
    ],
)
def test_what_does_not_exist_is_refused_in_one_line(words, message, capsys):
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert message in printed.err
    assert printed.err.count("\n") == 1


def test_options_of_a_training_reach_predictor_features_and_loop(monkeypatch):
    asked = []
    monkeypatch.setattr("foretrace.cli.training._train", lambda *given: asked.append(given))
    command = ["train", "--data", "d", "--out", "o"]
    features = ["--features", "ae-256", "--feature-epochs", "1", "--width", "8"]
    assert cli.main([*command, *features, "--epochs", "3", "--hidden", "4", "--split", "6", "2", "2"]) == 0
    assert cli.main([*command, "--predictor=one-shot", "--heights", "--outcomes", "levered", "slipped"]) == 0
    (_, _, lstm, loop, split, _), (_, _, one_shot, other_loop, no_split, _) = asked
    assert lstm.features == "ae-256"
    assert (lstm.feature_options, lstm.hidden) == ({"epochs": 1, "width": 8}, 4)
    assert (loop.epochs, split, no_split) == (3, (6, 2, 2), None)
    assert one_shot.feature_options == {"heights": True}
    assert one_shot.outcomes == ("levered", "slipped")
    assert other_loop == type(one_shot).training


@pytest.mark.parametrize(
    "words",
    [
        ["simulate"],
        ["train"],
        ["train", "--predictor"],
        ["simulate", "--out", "o", "--objects", "many"],
        ["train", "--data", "d", "--out", "o", "--device", "gpu"],
        ["train", "--data", "d", "--out", "o", "--split", "1", "2"],
        ["train", "--data", "d", "--out", "o", "--predictor", "one-shot", "--state", "pose"],
        ["train", "--data", "d", "--out", "o", "--predictor", "one-shot", "--steps-ahead", "2"],
        ["train", "--data", "d", "--out", "o", "--components", "8"],
        ["train", "--data", "d", "--out", "o", "--heights"],
    ],
)
def test_options_that_a_command_does_not_have_are_refused(words, capsys):
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert re.fullmatch(
        r"foretrace: error: [^\n]+; `foretrace [a-z ]+ --help` lists the options\n", printed.err
    )


def test_help_imports_nothing_slow():
    code = (
        "import sys; from foretrace.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "slow = {'torch', 'mujoco', 'matplotlib', 'pandas', 'pyarrow', 'scipy', 'cv2', 'joblib'}\n"
        "sys.exit(' '.join(slow & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "printing",
    [
        "main(['--version'])",
        "main(['simulate', '--help'])",
        "main(['said'])",
        "main(['tabulated'])",
    ],
)
def test_a_reader_that_has_gone_ends_a_command_in_silence(printing):
    code = (
        "import sys; from rich.console import Console; from foretrace import cli; from foretrace.cli import main\n"
        "def said(): print('line\\n' * 100_000)\n"
        "def tabulated(): Console().print('line\\n' * 10_000)\n"
        "cli.COMMANDS |= {'said': said, 'tabulated': tabulated}\n"
        f"sys.exit({printing})"
    )
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as output:
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment(), stdout=output, stderr=subprocess.PIPE, text=True
        )
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("command", ["data --out", "show --id 3 --out"])
def test_a_file_in_the_way_of_an_output_is_told_in_one_line(command, folder, tmp_path, capsys):
    name, *options = command.split()
    (tmp_path / "file").write_text("kept")
    capsys.readouterr()
    assert cli.main([name, str(folder), *options, str(tmp_path / "file" / "output.png")]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("foretrace: error: ")
    assert printed.count("\n") == 1
    assert f"cannot be made: {tmp_path / 'file'} is a file" in printed


def test_ctrl_c_while_a_compiled_module_is_loaded_is_no_error(monkeypatch, capsys):
    def interrupted():
        try:
            raise ImportError("initialization failed") from KeyboardInterrupt()
        except ImportError as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setitem(cli.COMMANDS, "interrupted", interrupted)
    assert cli.main(["interrupted"]) == 130
    assert capsys.readouterr().err == ""


def group_lives(group: int) -> bool:
    """Whether a process group still has members."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_keeps_what_is_done_and_says_how_to_go_on(tmp_path, sent):
    fast = ["--embodiment", "tool", "--insert-time", "0.1", "--lift-time", "0.2", "--hold-time", "0"]
    command = [sys.executable, "-m", "foretrace", "simulate", "--out", str(tmp_path / "data"), *fast]
    process = subprocess.Popen(
        [*command, "--workers", "2"],
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "data" / storage.shard_name(0)).exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    if sent == signal.SIGINT:
        os.killpg(process.pid, sent)  # what a terminal does: to the parent and its workers
    else:
        process.send_signal(sent)
    _, printed = process.communicate(timeout=60)
    assert process.returncode == 128 + sent
    assert "Traceback" not in printed
    assert printed.splitlines()[-1].startswith("foretrace: interrupted; what is done stays in")
    assert (tmp_path / "data" / storage.shard_name(0)).exists()
    while group_lives(process.pid):
        assert time.monotonic() < deadline, "workers were left behind"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["predict", "--out", "file"], "--out file is a file: name a folder"),
        (["predict", "--out", "file/below"], "file is a file; choose another --out"),
        (["train", "--data", "d", "--out", "/proc/below"], "--out /proc/below cannot be written (/proc: "),
        (["export", "lerobot", "--data", "d", "--out", "file/below"], "file is a file; choose another"),
        (["export", "onnx", "--out", "folder"], "--out folder is a folder: name a file"),
        (
            ["data", "folder", "--out", "folder/x.json"],
            "--out folder/x.json lies in the data set: choose another",
        ),
        (["demo", "--seed", "-1"], "seed is -1: give a whole number from 0"),
        (["data", "folder"], "or make one with `foretrace simulate --out data/NAME`"),
        (["data", "file"], "file is a file: give the folder of a data set"),
    ],
)
def test_where_nothing_can_be_written_is_said_first(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    assert cli.main(words) == 2
    assert message in capsys.readouterr().err
    assert {each.name for each in tmp_path.iterdir()} == {"file", "folder"}


def test_so_many_epochs_as_are_asked_for(tmp_path, folder, capsys):
    train = ["train", "--data", str(folder), "--features", "none", "--hidden", "4", "--threads", "1"]
    assert cli.main([*train, "--out", str(tmp_path / "run"), "--epochs", "2"]) == 0
    assert "epoch 2/2" in capsys.readouterr().out
    assert cli.main([*train, "--out", str(tmp_path / "none"), "--outcomes", "rolled"]) == 2
    assert "no interaction has an outcome among rolled; the data has: levered" in capsys.readouterr().err


ENDING = """
import sys, threading, time
from foretrace import cli
threading._register_atexit(lambda: (print("ending", flush=True), time.sleep(30)))  # as loky waits for its workers
sys.argv = ["foretrace", "--version"]
sys.exit(cli.main())
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_after_the_work_ends_the_process_without_a_word():
    process = subprocess.Popen(
        [sys.executable, "-c", ENDING], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    while process.stdout.readline().strip() != "ending":
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == -signal.SIGINT
    assert errors == ""


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_python_would_lose_is_heard(tmp_path, sent):
    script = tmp_path / "deaf.py"
    script.write_text(
        "import os, signal, sys, time\n"
        "import foretrace.cli as cli\n"
        "class Deaf:\n"
        "    def __del__(self):  # exceptions of destructors are ignored\n"
        f"        os.kill(os.getpid(), {int(sent)})\n"
        "        sum(range(1000))\n"
        "def slow():\n"
        "    Deaf()\n"
        "    time.sleep(60)\n"
        "cli.read = lambda arguments: slow\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.exit(cli.main(['slow']))\n"
    )
    done = subprocess.run([sys.executable, str(script)], timeout=30, capture_output=True, text=True)
    assert done.returncode == 128 + sent
    assert "ignored" not in done.stderr
