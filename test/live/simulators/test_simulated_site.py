"""The simulated site: two tanks with level sensors."""

from __future__ import annotations

import pytest
from paper import PAPER_SITE
from places import CONFIG

from greenroof_ros.live.devices.sensor_file import read_sensors
from greenroof_ros.live.simulators.site import SimulatedSite

SENSORS = read_sensors(CONFIG / "sensors.yaml")


def test_levels_move_by_the_volume_that_the_drives_speed_stands_for() -> None:
    """At 0.8 of rated speed, by hand, Eqs. (3b) and (3c) with the affinity laws.

    Head 0.64 x 55.2 + 3 - 16 = 22.328 m; resistance (3.56 x 18.4 / 0.2 + 0.6) / (2 x 9.81 x
    0.0314159^2) + 5.78e5 = 594945 s2/m5; flow (22.328 / 594945)^0.5 = 6.1261e-3 m3/s. In 40 s that
    is 0.2450 m3, and the level falls by 9.8 mm on 25 m2, which reduces the flow by 0.02 %; the roof
    of 68.8 m2 rises by 3.56 mm, and by 9e-6 m each second: 36 mm/h is 1e-5 m/s, 86.4 mm a day 1e-6
    m/s. The sensors have counts of 0.1 mm.
    """
    site = SimulatedSite(
        PAPER_SITE, [1e-5], [1e-6 * PAPER_SITE.a2], (75.0, 3.44), SENSORS, lambda: 0.8
    )
    for _ in range(40):
        site.step(site.flow(0.8))
    ticks, (cistern, roof) = site.virtual_site.tick, site.virtual_site.levels()
    assert site.pumped == pytest.approx(6.1261e-3 * ticks, rel=5e-4)
    assert cistern == pytest.approx(3 - site.pumped / 25, abs=1e-5)
    assert roof == pytest.approx(0.05 + site.pumped / 68.8 + ticks * 9e-6, abs=1e-5)
    read = [site.words(name, SENSORS.by_section[name])[0] for name in ("cistern", "roof")]
    assert read == pytest.approx([1e4 * cistern, 1e4 * roof], abs=1)


