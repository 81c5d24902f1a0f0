"""Storm water that a valve keeps out of the sewer in one season, and the mains water used."""

import greenroof_ros as gr

# 300 m² of ordinary roof drains into a cistern of 10 m³, which waters 68.8 m² of green roof.
site = gr.read_site("config/site_valve.yaml", tau=300.0)
season = {"site": site, "weather": "config/weather/toronto_2021.csv", "gaps": "fill",
          "start": "2021-05-01", "hours": 4416}
runs = gr.compare({
    outlet: gr.simulate("onoff", outlet=outlet, **season) for outlet in ("closed", "drain", "plan")
})
print(runs.table["controller", "wet_discharge_m3", "discharge_m3", "retention_share", "mains_m3"])
