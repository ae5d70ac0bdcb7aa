"""Values on their way between processes."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from sfm_app.runtime.cluster import SMALL_BYTES, packing, unpack
from sfm_app.tasks import Shared


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return Path.touch, (Path(self.path),)


@pytest.mark.parametrize("size", [10, SMALL_BYTES])
def test_values_arrive_whatever_their_size(tmp_path, size):
    with packing(tmp_path) as packer:
        parcel = packer.pack([np.arange(size), Path("here")])
        values, path = unpack(parcel)
    np.testing.assert_array_equal(values, np.arange(size))
    assert path == Path("here").absolute()
    assert bool(parcel.path) == (size == SMALL_BYTES)


def test_a_file_that_was_exchanged_is_not_unpickled(tmp_path):
    sprung = tmp_path / "sprung"
    with packing(tmp_path / "parcels") as packer:
        parcel = packer.pack(np.arange(SMALL_BYTES))
        Path(parcel.path).write_bytes(pickle.dumps(Trap(sprung)))
        with pytest.raises(OSError, match="not the file that was sent"):
            unpack(parcel)
    assert not sprung.exists()
    pickle.loads(pickle.dumps(Trap(sprung)))  # noqa: S301
    assert sprung.exists()  # the trap works


def test_a_shared_file_that_was_exchanged_is_not_unpickled(tmp_path):
    sprung = tmp_path / "sprung"
    with packing(tmp_path / "parcels") as packer:
        parcel = packer.pack([Shared(np.arange(10))])
        (file,) = (tmp_path / "parcels").iterdir()
        assert unpack(packer.pack([Shared(5)]))[0].value == 5
        file.write_bytes(pickle.dumps(Trap(sprung)))
        with pytest.raises(OSError, match="not the file that was sent"):
            unpack(parcel)
    assert not sprung.exists()
