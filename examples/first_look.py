# %% [markdown]
# # A first look
#
# Simulate a green roof that a pump waters from a rainwater cistern, plot it, compare controllers,
# and vary the target. ROS is not needed: `pip install "greenroof_ros[study]"`.

# %%
import tempfile

import altair
import polars

import greenroof_ros as gr

_ = altair.renderers.enable("png", ppi=110)  # pictures that GitHub also shows

# %% [markdown]
# ## Run
#
# The site and the weather are those of the paper unless you specify others. A tick lasts 10 s here.

# %%
inputs = {"site": gr.read_site(tau=10.0), "start": "2021-07-07T00:00", "hours": 48}
result = gr.simulate("onoff", **inputs)
{name: round(result.metrics[name], 2) for name in ("pumped_m3", "outflow_m3", "pump_starts")}

# %%
result.trajectory["time", "roof_level_m", "cistern_level_m", "command"].head(3)

# %% [markdown]
# ## Plot
#
# From top to bottom: the rain, the roof's level with its target, the cistern, and the pump.

# %%
result.plot()

# %% [markdown]
# ## Compare
#
# A controller is a name, a class, or a function of the state and the forecast. This function does
# not water the roof if 3 mm of rain are forecast for the next 6 h.


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
# How much more water does a higher target need?

# %%
sweep = polars.DataFrame([
    {"target (mm)": target, "pumped (m³)": gr.simulate(
        "onoff", **{**inputs, "site": gr.read_site(tau=10.0, z_veg=target / 1000)}
    ).metrics["pumped_m3"]} for target in (30, 35, 40, 45, 50, 55)
])
sweep.plot.line(x="target (mm)", y="pumped (m³)").properties(width=400, height=160)

# %% [markdown]
# ## Read a recording
#
# `read_bag` reads the recording of a node graph or of a real site, and a saved run.
# `greenroof report` also reads all of these.

# %%
with tempfile.TemporaryDirectory() as directory:
    recorded = gr.read_bag(result.save(directory))
recorded.group_by_dynamic("time", every="12h").agg(
    polars.col("roof_level_m").mean(), polars.col("cistern_level_m").min()
)
