"""The roof under a record's rain is the plant's."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from twins import TWIN, storms

from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.simulation import simulate
from greenroof_ros.model.plant import Plant


@pytest.mark.parametrize("step_s", [60.0, 300.0, 3600.0])
def test_the_plant_does_the_same(step_s: float) -> None:
    random = np.random.default_rng(3)
    rain = storms(20, random)
    reference = np.maximum(0.0, random.normal(0.01, 0.01, len(rain)))
    pumped = np.where(random.random(len(rain)) < 0.002, 1.5, 0.0)
    record = Record(
        Path("none"), datetime(2021, 5, 1, tzinfo=timezone.utc), step_s, rain, reference, pumped,
        np.zeros(len(rain)), None,
    )
    simulated = simulate(TWIN, record, 0.7)
    plant = Plant(
        replace(TWIN, tau=step_s, z_o=1e9), 1e6, TWIN.wilting_volume + 0.7 * TWIN.available_volume
    )
    runoff, level = [], []
    flow = TWIN.a2 / 1000 / step_s
    for fell, wanted, came in zip(rain, reference, pumped, strict=True):
        level.append(plant.levels()[1])
        precipitation = float(fell / 1000 / step_s)
        flows = plant.flows(
            precipitation, float(wanted * TWIN.crop_coefficient * flow), float(came * flow)
        )
        runoff.append(flows.drainage / flow)
        plant.step(precipitation, flows)
    assert pumped.any()
    assert simulated.level == pytest.approx(np.array(level), abs=1e-12)
    assert simulated.runoff == pytest.approx(np.array(runoff), abs=1e-7)
