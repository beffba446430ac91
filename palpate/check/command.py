"""`palpate check ROLE`: the conformance kit for an implementation of a role."""

from typing import Annotated

import typer

from palpate.live.bus import AsJson, Connect
from palpate.run.options import Settings

LISTEN = "tcp/127.0.0.1:7447"


def check_command(  # noqa: PLR0913 - the options of a command
    role: Annotated[str, typer.Argument(help="A role, such as tissue. An unknown one gives a list of all.")],
    connect: Connect = None,
    listen: Annotated[str, typer.Option(help="Endpoint at which the check waits for the implementation, as a router.")] = LISTEN,
    start: Annotated[str | None, typer.Option(metavar="COMMAND", help="Start the implementation with this command.")] = None,
    service: Annotated[
        str | None,
        typer.Option(metavar="NAME_OR_FILE", help="Check an implementation or a Python file in this process, in simulated time."),
    ] = None,
    scenario: Annotated[str, typer.Option(help="Its scenario; the patient holds their breath.")] = "clean",
    given: Settings = None,
    motion: Annotated[bool, typer.Option("--motion", help="It may move; most checks of the robot need this.")] = False,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="ROS domain.")] = 0,
    slack: Annotated[float, typer.Option(min=0, help="Seconds that transport and scheduler may add to a reaction.")] = 0.15,
    wait: Annotated[float, typer.Option(min=1, help="Seconds to wait for it to join.")] = 60.0,
    as_json: AsJson = False,
    failures: Annotated[bool, typer.Option("--failures", help="Print only what failed.")] = False,
) -> None:
    """Test an implementation of a role: rates, ranges, signs, frames, limits, expiry, safe hold, invalid and missing messages.

    The check plays the conductor and all other roles. The exit status is 0 if everything passed, 1 if something failed, 2 if no
    implementation joined. docs/conformance.md lists the requirements.
    """
    from palpate.check.perform import check_here, check_live, print_report
    from palpate.check.rig import RigSettings
    from palpate.check.suites import SUITES
    from palpate.check.suites.tissue import STILL
    from palpate.console import print_json
    from palpate_bus.runs.announcement import NoBusError
    from palpate_errors import ExitStatus
    from palpate_models.scenario.load import load_scenario

    if role not in SUITES:
        own = "; for a role of your own write a module with suite(rig) in palpate/check/suites"
        raise NoBusError(f"no suite for {role!r}; there is one for {', '.join(SUITES)}{own}")
    settings = RigSettings(
        load_scenario(scenario, [*STILL, *(given or ())]), 1e3 * slack, motion or role != "robot" or service is not None
    )
    if service is not None:
        report = check_here(role, service, settings)
    else:
        report = check_live(role, settings, connect, listen, start, domain, wait)
    if as_json:
        print_json(report.as_json())
    else:
        print_report(report, failures)
    if not report.passed:
        raise typer.Exit(ExitStatus.TROUBLE)
