"""Share of a season's rain that green roofs without irrigation keep, by depth and exponent."""

import greenroof_ros as gr

for depth in (0.075, 0.100, 0.140):
    kept = []
    for exponent in (1.5, 2.0, 3.0):
        site = gr.read_site(
            "config/site_catchment.yaml", irrigation="none", substrate="extensive",
            substrate_depth=depth, z_veg=0.3 * depth, percolation_exponent=exponent, tau=300.0,
            initial_cistern=0.0, initial_roof=0.35 * depth * 68.8,
        )
        run = gr.simulate(
            site=site, weather="config/weather/toronto_2021.csv", gaps="fill",
            start="2021-05-01", hours=4416,
        )
        kept.append(f"{run.metrics['roof_retention_share']:.0%}")
    print(f"{1000 * depth:.0f} mm:", ", ".join(kept))
