"""Shared by the tests of the leaderboard."""

import pytest
from board_rows import write_result_file

from fpp_ml_bench.leaderboard.rows import read_entry


@pytest.fixture(scope="session")
def base(tmp_path_factory, dataset):
    """An entry of a real result, of which tests make rows with other errors."""
    return read_entry(write_result_file(tmp_path_factory.mktemp("base") / "base.json", dataset, 1.0))
