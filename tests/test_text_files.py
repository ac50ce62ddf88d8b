"""Text as editors, spreadsheets and drawing programs leave it: read as it is meant, or refused with the true reason."""

import codecs
from pathlib import Path

import pytest

from foretrace.errors import DatasetError, PerceptionError
from foretrace.files import LARGEST_TEXT, read_json, read_text
from foretrace.perception.recordings import open_recording

TEXT = "Größe,1\r\nλ,2\r"
ENCODINGS = {
    "utf-8": b"",
    "utf-8-sig": b"",
    "utf-16-le": codecs.BOM_UTF16_LE,
    "utf-16-be": codecs.BOM_UTF16_BE,
    "utf-32-le": codecs.BOM_UTF32_LE,
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_text_in_any_unicode(encoding, tmp_path):
    path = tmp_path / "text"
    path.write_bytes(ENCODINGS[encoding] + TEXT.encode(encoding))
    assert read_text(path, DatasetError, "") == TEXT
    path.write_bytes(ENCODINGS[encoding] + '{"Größe": 1}'.encode(encoding))
    assert read_json(path, dict, DatasetError, "") == {"Größe": 1}


def test_what_is_no_text(tmp_path):
    path = tmp_path / "text"
    path.write_bytes("12 größer".encode("cp1252"))
    with pytest.raises(
        DatasetError, match=r"is no text in UTF-8 \(byte 0xf6 at 5\): save it as UTF-8, or remedy$"
    ):
        read_text(path, DatasetError, "remedy")
    assert read_text(path, DatasetError, "", "latin-1") == "12 größer"
    path.write_bytes(b"\x89PNG\r\n\0\0")
    with pytest.raises(DatasetError, match=r"0x89 at 0"):
        read_text(path, DatasetError, "", "latin-1")
    for name, message in (
        (tmp_path, "Is a directory"),
        (tmp_path / "x\0", "null"),
        (tmp_path / "y", "not exist"),
    ):
        with pytest.raises(DatasetError, match=message):
            read_text(name, DatasetError, "")


def test_text_that_never_ends(tmp_path, monkeypatch):
    assert LARGEST_TEXT < 2**30
    monkeypatch.setattr("foretrace.files.LARGEST_TEXT", 2**20)
    with pytest.raises(DatasetError, match="longer than 1 MB"):
        read_text(tmp_path.joinpath("/dev/zero"), DatasetError, "")


TIMES = {
    "plain": "time_s,colour,depth\n0.5,a.png,\n0.75,b.png,d.png\n",
    "mark": "\ufefftime_s,colour,depth\r\n0.5,a.png,\r\n0.75,b.png,d.png\r\n",
    "semicolons": "time_s;colour;depth\n0,5;a.png;\n0,75;b.png;d.png\n",
    "tabs": "time_s\tcolour\tdepth\n0.5\ta.png\t\n0,75\tb.png\td.png\n",
    "spaces and quotes": 'Time_s, Colour, Depth, note\n0.5, "a.png", ,first\n0.75, b.png, d.png\n\n',
    "no depth": "colour,time_s\ra.png,0.5\rb.png,0.75\r",
}


@pytest.mark.parametrize("name", TIMES)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_time_stamps_from_a_spreadsheet(name, encoding, tmp_path, monkeypatch):
    (tmp_path / "timestamps.csv").write_bytes(TIMES[name].encode(encoding))
    for function, stub in {
        "read_image": Path.name.fget,
        "read_depth": Path.name.fget,
        "Frame": lambda *a: a,
    }.items():
        monkeypatch.setattr(f"foretrace.perception.recordings.{function}", stub)
    assert list(open_recording(tmp_path).frames()) == [
        (0.5, "a.png", None),
        (0.75, "b.png", None if name == "no depth" else "d.png"),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the column time_s"),
        ("time_s,image\n0.5,a.png", "lacks the column colour (its first line is 'time_s,image')"),
        ("time_s,colour\n\n", "lists no frame"),
        ("time_s,colour\n0.5,a.png\n\nhalf,b.png", "line 4: time_s is 'half'"),
        ("time_s,colour\nnan,a.png", "line 2: time_s is 'nan'"),
        ("time_s,colour\n0.5,", "line 2: colour is empty"),
        ("time_s,colour\n0,5,a.png", "line 2 has 3 entries, the first line 2"),
        ("time_s,colour\n0.5", "line 2: colour is empty"),
        ("time_s,colour\n0.5," + 200_000 * "a", "cannot be read (field larger"),
    ],
)
def test_time_stamps_that_cannot_be_read(text, message, tmp_path):
    (tmp_path / "timestamps.csv").write_text(text)
    with pytest.raises(PerceptionError) as error:
        open_recording(tmp_path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
