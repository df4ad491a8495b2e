"""Files that keep arrays under a key."""

import hashlib

import numpy as np
import pytest

from jaxcloseup.io import cache
from jaxcloseup.io.cache import Stored, cached, load, save


ARRAYS = {"image": np.arange(600, dtype=np.uint8).reshape(20, 30), "depth": np.float32(0.5)}
RECORD = {"sizes": [[2, 3]], "name": "é"}


class Maker:
    """Counts how often its value is made, and collects what is reported."""

    def __init__(self, path):
        self.path, self.made, self.said = path, 0, []

    def make(self):
        self.made += 1
        return Stored(ARRAYS, RECORD)

    def get(self, key="a", level=0):
        unchanged = {"pack": lambda value: value, "unpack": self.unpack}
        return cached(self.path, key, self.make, **unchanged, level=level, report=self.said.append)

    def unpack(self, stored):
        if set(stored.arrays) != set(ARRAYS):
            raise ValueError("other arrays")
        return stored


@pytest.fixture
def maker(tmp_path):
    return Maker(tmp_path / "new" / "a.npz")


@pytest.mark.parametrize("level", [0, 1, 9])
def test_a_value_is_made_once_per_key(maker, level):
    for _ in range(3):
        stored = maker.get(level=level)
        assert stored.record == RECORD and set(stored.arrays) == set(ARRAYS)
        for name, array in ARRAYS.items():
            assert stored.arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(stored.arrays[name], array)
    assert maker.made == 1
    maker.get("b")
    maker.get("b")
    assert maker.made == 2 and not maker.said
    assert [path.name for path in maker.path.parent.iterdir()] == ["a.npz"]


def test_every_damaged_byte_is_noticed(maker):
    maker.get(level=1)
    whole = maker.path.read_bytes()
    damages = [b"", whole[:-1], whole + b"x", b"x" * 100, hashlib.sha256(b"x").digest() + b"x"]
    flipped = range(0, len(whole), 7)
    damages += [whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in flipped]
    for damaged in damages:
        maker.path.write_bytes(damaged)
        np.testing.assert_array_equal(maker.get(level=1).arrays["image"], ARRAYS["image"])
        assert maker.path.read_bytes() == whole
    assert maker.made == 1 + len(damages) == 1 + len(maker.said)
    assert all("a.npz is damaged (" in sentence for sentence in maker.said)


def test_other_content_is_made_again(maker):
    save(maker.path, "a", Stored({"other": np.zeros(3)}))
    maker.get()
    assert maker.made == 1 and len(maker.said) == 1


def test_a_path_that_cannot_be_written_costs_only_a_sentence(maker):
    maker.path.mkdir(parents=True)
    assert maker.get().record == RECORD
    assert [sentence.count("made again next time") for sentence in maker.said] == [0, 1]


def test_large_files_are_refused_before_they_are_unpacked(maker):
    save(maker.path, "a", Stored({"zeros": np.zeros(10**6, np.uint8)}), level=9)
    size = maker.path.stat().st_size
    with pytest.raises(ValueError, match="unpacked, the file has more than"):
        load(maker.path, "a", most=size)
    with pytest.raises(OSError, match="More than"):
        load(maker.path, "a", most=size - 1)


def test_objects_are_refused(maker):
    with pytest.raises(ValueError, match="allow_pickle"):
        save(maker.path, "a", Stored({"objects": np.array([{}], object)}))
    assert not maker.path.exists()


def test_the_hash_of_files_depends_on_where_each_one_ends(tmp_path):
    (tmp_path / "a").write_bytes(b"12")
    (tmp_path / "b").write_bytes(b"3")
    before = cache.hash_files([tmp_path / "a", tmp_path / "b"])
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"23")
    assert cache.hash_files([tmp_path / "a", tmp_path / "b"]) != before
