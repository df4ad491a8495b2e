"""Strict JSON files."""

import json
import math

import pytest

from jaxcloseup.io.files import strict, write_json


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
