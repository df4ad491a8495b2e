"""What Ctrl-C says of an output folder is what the next command can do."""

import pytest
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import output_folder


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """A function that returns what Ctrl-C says of a folder of a sweep."""
    flags.FLAGS(["sweep"])
    said = []
    monkeypatch.setattr(output_folder, "when_stopped", said.append)
    monkeypatch.setattr("sys.argv", ["sweep", "--methods=ngp"])

    def call(folder, **given):
        with flagsaver.flagsaver(output_dir=None):
            output_folder.prepare_to_stop(folder, "sweep", **given)
        return said.pop()()

    return call


def test_a_folder_that_can_be_resumed_is_named(tmp_path, stopped):
    assert stopped(tmp_path).endswith("before training began: give the same command again")
    (tmp_path / output_folder.LOCK).touch()
    assert stopped(tmp_path).endswith("before training began: give the same command again")
    (tmp_path / "manifest.json").touch()
    with pytest.raises(FileExistsError):  # so the same command would be refused
        output_folder.choose_output_dir(str(tmp_path), "table", "ngp")
    assert stopped(tmp_path).endswith(f"remove {tmp_path}, and give the same command again")
    (tmp_path / "checkpoints").mkdir()
    resume = f"--methods=ngp --output_dir={tmp_path} --resume"
    assert stopped(tmp_path).endswith(resume)


def test_a_sweep_of_methods_is_resumed_by_its_flags(tmp_path, stopped):
    """Checkpoints lie in the folders of its methods."""
    (tmp_path / "ngp" / "table" / "checkpoints").mkdir(parents=True)
    (tmp_path / "flags.json").touch()
    assert stopped(tmp_path, kept="flags.json").endswith(f"--output_dir={tmp_path} --resume")
    given = {"kept": "flags.json"}
    with pytest.raises(FileExistsError, match="resume its training with --resume"):
        output_folder.choose_output_dir(str(tmp_path), "sweep", "methods", **given)
    found = output_folder.choose_output_dir(str(tmp_path), "sweep", "methods", resume=True, **given)
    assert found == tmp_path
