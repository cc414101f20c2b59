"""A notebook that tunes the virtual axis on a slider: marimo edit examples/tuning.py; a script as well."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(width="medium")

with app.setup:
    import marimo as mo
    import matplotlib.pyplot as plt

    import pneud
    from pneud.study.gains import error_scale_m
    from pneud.study.proposing import propose


@app.cell
def _():
    bandwidth = mo.ui.slider(15, 60, step=5, value=45, label="bandwidth [rad/s]", show_value=True)
    believed = mo.ui.slider(0.0, 2.0, step=0.25, value=1.0, label="friction believed in", show_value=True)
    mo.vstack([mo.md("# The error of an axis over its bandwidth"), bandwidth, believed])
    return bandwidth, believed


@app.cell
def _(bandwidth, believed):
    config = pneud.load_config("virtual.toml")
    law, dry = config.control, config.control.friction
    designed = propose(config, law.law, float(bandwidth.value), error_scale_m(config), law.alpha)
    friction = {
        "friction.coulomb_n": believed.value * dry.coulomb_n,
        "friction.static_n": believed.value * dry.static_n,
    }
    run = pneud.simulate(designed.config, duration_s=8.0, seed=1, gains=friction)
    return designed, run


@app.cell
def _(run):
    frame = run.to_pandas(["t_s", "true_error_m", "command.voltage_v", "state_name"])
    tracking = frame[(frame.state_name == "tracking") & (frame.t_s > 1.0)]
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(9, 5), layout="constrained")
    above.plot(tracking.t_s, 1e6 * tracking.true_error_m, linewidth=0.8)
    above.set_ylabel("error [µm]")
    below.plot(tracking.t_s, tracking["command.voltage_v"], linewidth=0.8)
    below.set(xlabel="time [s]", ylabel="command [V]")
    mo.as_html(figure)
    return (figure,)


@app.cell
def _(designed, run):
    doubts = "\n".join(f"* {doubt}" for doubt in designed.doubts) or "* nothing is doubtful"
    mo.vstack([mo.Html(run._repr_html_()), mo.md(doubts), mo.Html(run.motions()._repr_html_())])


@app.cell
def _(bandwidth, run):
    error = run.summary["tracking_mm"]
    print(f"{bandwidth.value} rad/s: {error['rms']:.4f} mm RMS, {error['max']:.4f} mm at most")


if __name__ == "__main__":
    app.run()
