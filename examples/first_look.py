# %% [markdown]
# # A first look
#
# Simulate a green roof that a pump waters from a storm cistern, draw it, compare controllers, and
# change the target. ROS is not needed: `pip install "greenroof_ros[study]"`.

# %%
import tempfile

import altair
import polars

import greenroof_ros as gr

_ = altair.renderers.enable("png", ppi=110)  # pictures that GitHub shows, too

# %% [markdown]
# ## Run
#
# The site and the weather are the paper's unless you give others. Here a tick lasts 10 s.

# %%
inputs = {"site": gr.read_site(tau=10.0), "start": "2021-07-07T00:00", "hours": 48}
result = gr.simulate("onoff", **inputs)
{name: round(result.metrics[name], 2) for name in ("pumped_m3", "outflow_m3", "pump_starts")}

# %%
result.trajectory["time", "roof_level_m", "cistern_level_m", "command"].head(3)

# %% [markdown]
# ## Plot
#
# Rain from above, the roof's level with its target, the cistern, and the pump.

# %%
result.plot()

# %% [markdown]
# ## Compare
#
# A controller is a name, a class, or a function of the state and the forecast. This function does
# not water if 3 mm of rain come within 6 h.


# %%
def waits(state, forecast):
    """Return the command."""
    lengths = forecast.ends[1:] - forecast.ends[:-1]
    dry = state.roof_level < state.site.z_veg
    return 1.0 if dry and 1000 * forecast.rain @ lengths < 3 else 0.0


compared = gr.compare({
    "on/off": result,
    "MPC": "mpc",
    "lookahead, 24 h": gr.simulate("lookahead", horizon=24, **inputs),
    "waits for rain": gr.simulate(waits, horizon=6, **inputs),
}, **inputs)
compared.table["controller", "mean_deviation_mm", "pumped_m3", "outflow_m3", "pump_starts"]

# %%
compared.plot()

# %% [markdown]
# ## Sweep the target
#
# How much water a higher target takes.

# %%
sweep = polars.DataFrame([
    {"target (mm)": target, "pumped (m³)": gr.simulate(
        "onoff", **{**inputs, "site": gr.read_site(tau=10.0, z_veg=target / 1000)}
    ).metrics["pumped_m3"]} for target in (30, 35, 40, 45, 50, 55)
])
sweep.plot.line(x="target (mm)", y="pumped (m³)").properties(width=400, height=160)

# %% [markdown]
# ## Read a bag
#
# `read_bag` reads a run of the node graph, a bag of a real site, and a saved run, which
# `greenroof report` takes, too.

# %%
with tempfile.TemporaryDirectory() as directory:
    recorded = gr.read_bag(result.save(directory))
recorded.group_by_dynamic("time", every="12h").agg(
    polars.col("roof_level_m").mean(), polars.col("cistern_level_m").min()
)
