"""Whatever is asked of the command, it ends in a result or in one message with a documented exit code."""

import pytest
from random_commands import OFTEN, commands, make_files, trouble


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands") / "files"
    folder.mkdir()
    return make_files(folder), folder


def test_every_command_is_drawn():
    assert {*commands()} - {"workbench"} == {*OFTEN}  # a page stays open until it is interrupted


@pytest.mark.sampled(3)
@pytest.mark.parametrize("block", range(9))
def test_random_commands_end_in_a_result_or_one_message(block, files):
    calls = range(100 * block, 100 * block + (5 if block < 3 else 30))
    assert [found for found in (trouble(seed, *files) for seed in calls) if found] == []
