"""Whatever is asked of `optid.fit`, it ends in a fit or in an error of optid, and leaves the caller's arrays alone."""

import pytest
from random_calls import trouble


@pytest.mark.sampled(3)
@pytest.mark.parametrize("block", range(9))
def test_random_calls_end_in_a_fit_or_a_named_error(block):
    calls = range(100 * block, 100 * block + (10 if block < 3 else 40))
    assert [found for found in map(trouble, calls) if found] == []
