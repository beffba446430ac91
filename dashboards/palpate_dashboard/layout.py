"""Viewer layout: large scene, maps and depth image below it, text and plots to its right."""

from collections.abc import Sequence
from typing import Any

import rerun.blueprint as rrb

from palpate_dashboard.sinks import TIMELINE


def _eye(position: tuple[float, float, float], target: tuple[float, float, float], up: tuple[float, float, float]) -> Any:
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=up)


def _whole_past() -> Any:
    return rrb.VisibleTimeRange(TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative())


_HIDDEN = rrb.EntityBehavior(visible=False)
"""Hidden until the user clicks the eye next to its name: the picture shows no ground truth by default."""


def _scene() -> Any:
    return rrb.Spatial3DView(
        name="Examination (world frame, m)",
        origin="/world",
        contents=["+ $origin/**", "- /world/camera/depth"],
        background=(24, 27, 33),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.25, color=(255, 255, 255, 18)),
        eye_controls=_eye((1.10, -1.46, 2.24), (0.41, 0.03, 1.30), (0.0, 0.0, 1.0)),
        overrides={
            "/world/tool/travelled": rrb.VisibleTimeRanges([_whole_past()]),
            "/world/perception/normals": _HIDDEN,
            "/world/perception/surface": _HIDDEN,
            "/world/truth/lesions": _HIDDEN,
            "/world/truth/axes": _HIDDEN,
        },
    )


MAP_MARGIN_M = 0.08
"""Space around the region in the map views: margins and the legend, whose size is fixed."""


def _map(layer: str, name: str, region_m: tuple[float, float], centre_m: tuple[float, float]) -> Any:
    x, y = centre_m[0] + 0.025, centre_m[1]
    distance = 0.93 * (max(region_m) + MAP_MARGIN_M)
    return rrb.Spatial3DView(
        name=name,
        origin=f"/map/{layer}",
        background=(24, 27, 33),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye((x, y - 1e-3, distance), (x, y, 0.0), (0.0, 1.0, 0.0)),
        overrides={f"/map/{layer}/truth": _HIDDEN},
    )


PAST_S, LEGEND_S = 60.0, 35.0
"""Plot window before the cursor, and space for the legend after it."""


def _plot(name: str, origin: str, bounds: tuple[float, float] | None = None, hidden: Sequence[str] = ()) -> Any:
    """Return a plot of the series below `origin` over the last minute; `hidden` ones are initially off.

    Without `bounds` the axis fits the data.
    """
    window = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PAST_S), end=rrb.TimeRangeBoundary.cursor_relative(seconds=LEGEND_S)
    )
    return rrb.TimeSeriesView(
        name=name,
        origin=origin,
        axis_x=rrb.TimeAxis(view_range=window),
        axis_y=None if bounds is None else rrb.ScalarAxis(range=bounds, zoom_lock=False),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        overrides={f"{origin}/{name}": _HIDDEN for name in hidden},
    )


Bounds = tuple[tuple[float, float], tuple[float, float]]


def _force_depth(bounds: Bounds) -> Any:
    (x0, x1), (y0, y1) = bounds
    return rrb.Spatial2DView(
        name="Force over depth",
        origin="/force_depth",
        background=(14, 16, 20),
        visual_bounds=rrb.VisualBounds2D(x_range=(x0, x1), y_range=(y0, y1)),
        overrides={"/force_depth/past": rrb.VisibleTimeRanges([_whole_past()])},
    )


def blueprint(region_m: tuple[float, float], centre_m: tuple[float, float], depth_m: float, plane: Bounds) -> Any:
    """Return the layout for an examination of `region_m` around `centre_m` at `depth_m`.

    `plane`: visible bounds of the force-depth plane.
    """
    left = rrb.Vertical(
        _scene(),
        rrb.Horizontal(
            _map("mean", "Stiffness / background", region_m, centre_m),
            _map("band", "Uncertainty (90 % band)", region_m, centre_m),
            rrb.Tabs(
                _force_depth(plane),
                rrb.Spatial2DView(name="Depth image [m]", origin="/world/camera", contents=["/world/camera/depth"]),
            ),
            column_shares=[1, 1, 1.25],
        ),
        row_shares=[2.2, 1],
    )
    right = rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(name="Status", origin="/text/status"),
            rrb.TextDocumentView(name="Services", origin="/text/services"),
            rrb.StateTimelineView(name="Health", origin="/health"),
            rrb.TextLogView(name="Log", origin="/log"),
            rrb.TextDocumentView(name="Legend", origin="/text/legend"),
        ),
        rrb.StateTimelineView(name="Phase and driver", origin="/state"),
        _plot("Normal force [N]", "/plots/force", hidden=("true", "limit")),
        _plot("Depth [mm]", "/plots/depth", (-2.0, 1.4e3 * depth_m), hidden=("true",)),
        rrb.Tabs(
            _plot("Joint torque [% of limit]", "/plots/torque"),
            _plot("Real-time factor [1]", "/plots/speed"),
            _plot("Waited for [%]", "/plots/waits", (0.0, 100.0)),
            _plot("Progress [%]", "/plots/progress", (0.0, 100.0)),
            _plot("Wall [mm]", "/plots/wall"),
            _plot("TRUTH: patient [mm]", "/plots/truth"),
        ),
        row_shares=[1.6, 0.85, 1.2, 1.2, 1.2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.7, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_layout=False,
        auto_views=False,
    )
