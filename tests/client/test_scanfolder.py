"""Which files of a scan folder are sent, and what is said about those that cannot be."""

from __future__ import annotations

import json

import pytest
from splatct_client.errors import InputError
from splatct_client.scanfolder import read_scan_folder


def rewrite(folder, **changes):
    path = folder / "scan.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes), encoding="utf-8")


def test_everything_named_is_sent_and_the_truth_stays_at_home(scan):
    found = read_scan_folder(scan)
    assert set(found.sources) == {"scan.json", "projections.tif", "flat.tif", "dark.tif", "mask.tif"}
    sent = json.loads(found.scan_json)
    assert "simulation" not in sent and b"truth" not in found.scan_json
    assert sent["projections"]["kind"] == "counts"
    assert found.size == sum(len(s) if isinstance(s, bytes) else s.stat().st_size for s in found.sources.values())


def test_subfolders_are_flattened_and_scan_json_says_so(scan):
    for folder in ("cam/a", "cam/b"):
        (scan / folder).mkdir(parents=True)
        (scan / folder / "1.tif").write_bytes(folder.encode())
    (scan / "cam_a_1.tif").write_bytes(b"taken")
    names = ["cam/a/1.tif", "cam/b/1.tif", "cam_a_1.tif", "cam/a/1.tif"]
    rewrite(scan, projections={"files": names}, bad_pixels=None)
    found = read_scan_folder(scan)
    sent = json.loads(found.scan_json)["projections"]["files"]
    assert len(set(sent)) == 3 and sent[0] == sent[3] and all("/" not in name for name in sent)
    assert [found.files[name].read_bytes() for name in sent[:3]] == [b"cam/a", b"cam/b", b"taken"]


def test_names_are_sent_in_one_unicode_form(scan):
    (scan / "Ra\u0308nder.tif").write_bytes(b"x")  # as macOS writes it
    rewrite(scan, projections={"files": ["Ra\u0308nder.tif"]})
    found = read_scan_folder(scan)
    assert "R\u00e4nder.tif" in found.files
    assert json.loads(found.scan_json)["projections"]["files"] == ["R\u00e4nder.tif"]


def test_the_folder_names_a_scan_without_a_name(scan):
    rewrite(scan, name="")
    assert read_scan_folder(scan).name == "scan"


def test_all_problems_are_listed_at_once(scan):
    (scan / "flat.tif").unlink()
    (scan / "dark.tif").write_bytes(b"")
    rewrite(scan, bad_pixels=7)
    with pytest.raises(InputError) as caught:
        read_scan_folder(scan)
    text = str(caught.value)
    assert "flat.tif does not exist" in text and "dark.tif is empty" in text and "/bad_pixels: got 7" in text


@pytest.mark.parametrize("name", ["/etc/passwd", "../secret.tif", "a\\b.tif", "C:x.tif"])
def test_no_file_outside_the_folder_is_ever_sent(scan, name):
    (scan.parent / "secret.tif").write_bytes(b"secret")
    rewrite(scan, projections={"files": [name]})
    with pytest.raises(InputError, match="out of the scan folder"):
        read_scan_folder(scan)


@pytest.mark.parametrize("text", ["{", "[]", "\ufeff{}", "[" * 100000])
def test_a_broken_scan_json_is_said_to_be_broken(scan, text):
    (scan / "scan.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"scan\.json"):
        read_scan_folder(scan)
