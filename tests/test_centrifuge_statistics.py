"""What 95 % intervals cover, over thousands of shortened tests."""

import pytest

from centrifuge_trials import coverage_of


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [True, False], ids=["table_angle", "no-table_angle"])
def test_intervals_cover(encoder, reduced):
    shares = coverage_of(40 if reduced else 2000, encoder=encoder)
    print(shares)
    # 40 trials x 8 K_i are known to about 2 % (axes share the FOG, zeta_i share K_1).
    low, high = (0.90, 0.99) if reduced else (0.93, 0.97)
    for kind, share in shares.items():
        assert low <= share <= high, kind
