# SPDX-License-Identifier: Apache-2.0
import os
import time

import numpy as np
import pytest

from abyssnav.errors import PipelineError, ReadError
from abyssnav.geometry import wrap_angle
from abyssnav.read.parts import mcap_files
from abyssnav.second_process import InlineExecutor, peak_memory_mb, second_process
from abyssnav.tables import Depth


def test_it_answers_what_the_function_does_and_in_another_process():
    angles = np.linspace(-10.0, 10.0, 100_000)
    with second_process(["abyssnav.geometry"]) as executor:
        asked = [executor.submit(wrap_angle, angles), executor.submit(os.getpid)]
        np.testing.assert_array_equal(asked[0].result(), wrap_angle(angles))  # type: ignore[attr-defined]
        assert asked[1].result() != os.getpid()  # type: ignore[attr-defined]
        assert 5 < executor.peak_memory_mb < 10 * peak_memory_mb()


def test_tables_travel_whole_whatever_their_memory_looks_like():
    rows = np.arange(30.0).reshape(10, 3)
    depth = Depth(t_s=rows[:, 0], depth_m=rows[::-1, 2])
    with second_process([]) as executor:
        back = executor.submit(Depth.__getitem__, depth, slice(2, None)).result()
    np.testing.assert_array_equal(back.t_s, depth.t_s[2:])
    np.testing.assert_array_equal(back.depth_m, depth.depth_m[2:])


def test_a_refusal_there_is_one_here(tmp_path):
    with second_process([]) as executor:
        with pytest.raises(ReadError, match=r"no \.mcap file in this directory"):
            executor.submit(mcap_files, [tmp_path]).result()
        assert executor.submit(len, "abc").result() == 3


def test_a_process_that_dies_is_told():
    with (
        second_process([]) as executor,
        pytest.raises(PipelineError, match="the second process ended with status 3"),
    ):
        executor.submit(os._exit, 3).result()


def test_what_it_prints_is_no_answer(capfd):
    with second_process([]) as executor:
        assert executor.submit(print, "from afar").result() is None
    assert "from afar" not in capfd.readouterr().out


def test_it_ends_with_the_block():
    with second_process([]) as executor:
        number = executor.submit(os.getpid).result()
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_what_it_does_after_an_error_is_of_no_use_and_stopped():
    class StopError(Exception):
        pass

    def fail():
        with second_process([]) as executor:
            asked.append(executor.submit(time.sleep, 3600.0))
            raise StopError

    asked = []
    with pytest.raises(StopError):
        fail()
    with pytest.raises(PipelineError, match="the second process ended with status -9"):
        asked[0].result()


def test_what_hangs_comes_to_an_end():
    with (
        second_process([], timeout_s=0.5) as executor,
        pytest.raises(PipelineError, match="gave no answer within 0 s"),
    ):
        executor.submit(time.sleep, 3600.0).result()


def test_without_a_second_process_the_work_is_done_at_once():
    assert InlineExecutor().submit(len, "abc").result() == 3
    with pytest.raises(ReadError, match="no file"):
        InlineExecutor().submit(refuse).result()


def refuse():
    raise ReadError("there is no file")
