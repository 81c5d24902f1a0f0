"""Messages on /diagnostics as anyone on the network may send them."""

from __future__ import annotations

from hypothesis import strategies as st

from greenroof_ros.ros.reports import Status

TEXTS = st.text(max_size=30) | st.sampled_from([
    "/pump", "/pump: drive", "ready", "ended", "starting", "", ": ", "/", "\ud800\x00\u202e",
    "[" * 2000, "9" * 401, "1e999", "NaN", '"pump"', '"controller"', "{}", "[[1]]", '["x"]',
    '{"/a": 9' + "9" * 400 + "}", "null", "true", "-Infinity", "mqtt://\u202e/x", "1", "hold",
    '{"owner": "x", "since": 1e300, "until": -1e300}', '{"volume": 1e300, "delivered": -1e300}',
    "runs_on", "2021-07-20T05:00:30+00:00", "9999-12-31T23:59:59+00:00",
])
KEYS = st.sampled_from([
    "role", "process", "waiting", "failure", "up_s", "tick", "topics", "code", "age_s", "hold",
    "fault", "dose", "min_dose", "max_dose", "flow", "number", "since", "ended", "about", "follows",
])
STATUSES = st.lists(st.builds(
    Status, TEXTS, st.sampled_from(range(4)), TEXTS,
    st.dictionaries(KEYS | TEXTS, TEXTS, max_size=8), TEXTS,
), max_size=4)
