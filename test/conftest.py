"""What all tests share: where real data lie, and the message library of recordings."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real frames that are not part of the repository; the test is skipped where it is absent."""
    folder = Path(os.environ.get("RCSEG_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real data: set RCSEG_DATA to a folder with mosd_*, pcl_* and the laptop bag")
    return folder
