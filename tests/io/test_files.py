"""Files: strict JSON, whole or not at all, and only ordinary ones of a stated size."""

import json
import math

import pytest

from jaxcloseup.io.files import check_file, read_bytes, strict, write_json


VALUE = {"psnr": [1.5, math.nan], "views": {"a": (math.inf, -math.inf)}, "name": "x", "count": 3}
EXPECTED = {"psnr": [1.5, None], "views": {"a": [None, None]}, "name": "x", "count": 3}


def test_numbers_that_are_not_finite_become_null(tmp_path):
    assert strict(VALUE) == EXPECTED
    path = tmp_path / "new" / "a.json"
    write_json(path, VALUE)
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == EXPECTED


def test_a_value_that_is_not_json_leaves_the_old_file(tmp_path):
    write_json(tmp_path / "a.json", {"old": True})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"new": object()})
    assert json.loads((tmp_path / "a.json").read_text()) == {"old": True}
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_an_unwritable_path_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"file/a\.json cannot be written"):
        write_json(tmp_path / "file" / "a.json", {})


def test_devices_folders_and_large_files_are_not_read(tmp_path):
    with pytest.raises(OSError, match="Not an ordinary file"):
        read_bytes("/dev/zero")
    with pytest.raises(IsADirectoryError, match="Is a directory"):
        check_file(tmp_path)
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", most=5) == b"12345"
    with pytest.raises(OSError, match=r"More than 3\.8147e-06 MiB"):
        read_bytes(tmp_path / "a", most=4)
