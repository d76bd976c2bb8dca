"""Who asks, as far as limits are counted."""

from __future__ import annotations

import pytest
from aiohttp.test_utils import make_mocked_request
from multidict import CIMultiDict

from onedemo.app.network.bind import Listening, network


@pytest.mark.parametrize(
    ("lines", "who"),
    [
        (["6.6.6.6, 10.0.0.9"], "10.0.0.9"),
        (["6.6.6.6", "10.0.0.9"], "10.0.0.9"),  # the first line is of whoever asks
        (["6.6.6.6", "7.7.7.7, 10.0.0.9"], "10.0.0.9"),
        (["10.0.0.9:5678"], "10.0.0.9"),
        (["[2001:db8::1]:80"], "2001:db8::1"),
        (["[2001:db8::1]"], "2001:db8::1"),
        (["2001:db8::1"], "2001:db8::1"),
        (["::ffff:10.0.0.9"], "10.0.0.9"),
        (["6.6.6.6", "unknown"], "127.0.0.1"),  # whatever the proxy means, it is not what comes before
        (["6.6.6.6, "], "127.0.0.1"),
        (["٣.0.0.1"], "127.0.0.1"),
        ([], "127.0.0.1"),
    ],
)
def test_only_the_proxys_own_word_is_believed(lines, who):
    class Transport:
        def get_extra_info(self, name, default=None):
            return ("127.0.0.1", 4000) if name == "peername" else default

    headers = CIMultiDict([("X-Forwarded-For", line) for line in lines])
    request = make_mocked_request("GET", "/", headers=headers, transport=Transport())
    assert Listening(behind_proxy=True).client(request) == who
    assert Listening().client(request) == "127.0.0.1"


def test_a_line_of_ipv6_is_one_sender():
    assert network("2001:db8:1:2::1") == network("2001:db8:1:2:ffff::9") != network("2001:db8:1:3::1")
    assert network("::ffff:10.0.0.9") == network("10.0.0.9") != network("10.0.0.8")
    assert network("fe80::1%eth0") == network("fe80::2")
    assert network("unknown") == "unknown"
