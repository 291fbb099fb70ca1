from __future__ import annotations

from drivers.mavlink.wire.baud import BAUDS, BaudSearch

S = 10**9
STEP_NS = S // 10


def listen(search: BaudSearch, true_baud: int, rate_hz: float, seconds: float, t_ns: int) -> int:
    """A line on which packets of 40 bytes come; at a wrong rate their bytes are noise."""
    heard = 0.0
    for now_ns in range(t_ns, t_ns + round(seconds * S), STEP_NS):
        heard += rate_hz * 0.1
        n_packets, heard = int(heard), heard % 1
        if n_packets:
            good = search.baud == true_baud
            search.heard(40 * n_packets, n_packets if good else 0, now_ns)
        if search.found:
            return now_ns
        search.look(now_ns)
    return t_ns + round(seconds * S)


def test_every_rate_is_found_in_seconds_where_much_is_said() -> None:
    for baud in BAUDS:
        search = BaudSearch()
        search.begin(0)
        took_ns = listen(search, baud, rate_hz=100, seconds=20, t_ns=0)
        assert (search.found, search.baud) == (True, baud)
        assert took_ns < 5 * S


def test_every_rate_is_found_where_only_heartbeats_come() -> None:
    for baud in BAUDS:
        search = BaudSearch()
        search.begin(0)
        listen(search, baud, rate_hz=1, seconds=30, t_ns=0)
        assert (search.found, search.baud) == (True, baud)


def test_one_packet_is_not_believed_but_waited_on() -> None:
    search = BaudSearch((1, 2))
    search.begin(0)
    search.heard(40, 1, S)
    assert not search.found
    assert not search.look(3 * S)
    assert search.look(4 * S)
    assert search.baud == 2


def test_silence_goes_round() -> None:
    search = BaudSearch((1, 2, 3))
    search.begin(0)
    tried = []
    for t_ns in range(0, 6 * S, STEP_NS):
        if search.look(t_ns):
            tried.append(search.baud)
    assert tried == [2, 3, 1, 2]
    assert not search.found


def test_a_rate_that_was_good_is_kept_through_silence_and_tried_first_later() -> None:
    search = BaudSearch()
    search.begin(0)
    now_ns = listen(search, 460800, 50, 20, 0)
    assert not search.look(now_ns + 3600 * S)
    assert search.baud == 460800
    search.begin(now_ns + 3600 * S)
    assert (search.found, search.baud) == (False, 460800)
    search.heard(80, 2, now_ns + 3601 * S)
    assert search.found


def test_noise_for_long_begins_the_search_again() -> None:
    search = BaudSearch((1, 2))
    search.begin(0)
    search.heard(80, 2, S)
    for t_ns in range(S, 3 * S, STEP_NS):
        search.heard(500, 0, t_ns)
    assert search.found  # a burst of noise is no new rate
    for t_ns in range(3 * S, 6 * S, STEP_NS):
        search.heard(500, 0, t_ns)
    assert not search.found
    assert search.garbled
    assert search.look(6 * S)
    assert search.baud == 2


def test_a_rate_that_was_given_is_kept_but_noise_is_noted() -> None:
    search = BaudSearch((57600,))
    search.begin(0)
    for t_ns in range(0, 5 * S, STEP_NS):
        search.heard(200, 0, t_ns)
        assert not search.look(t_ns)
    assert search.baud == 57600
    assert search.garbled
    search.heard(40, 1, 6 * S)
    assert not search.garbled
