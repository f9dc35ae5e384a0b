"""Checks of an amplifier as items of a pytest session.

pytest selects the checks, runs them and writes the JUnit report. Configuration files, environment
variables and plug-ins that are installed on the computer do not change the session.
"""

import asyncio
import os
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import CommandError
from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.conformance_report import CheckResult, ConformanceReport, Result
from era_haptics.lab.conformance.connection import opened
from era_haptics.lab.conformance.contract import of_kind
from era_haptics.lab.conformance.judge_client import JudgeClient
from era_haptics.lab.conformance.run import ConformanceRun

DEFAULT_LEVEL = 0.2
"""Default level of driven channels: perceptible and far from any limit."""
_BLOCKED_PLUGINS = (
    "cacheprovider",
    "faulthandler",
    "logging",
    "terminal",
    "threadexception",
    "unraisableexception",
    "warnings",
)
"""Plug-ins of pytest that print, write files or change the process."""
_OPTIONS = (
    *("-c", os.devnull, "--rootdir", ".", "--noconftest", "--capture=no", "--assert=plain"),
    *(f"-pno:{name}" for name in _BLOCKED_PLUGINS),
    *("-o", "junit_suite_name=conformance"),
)


class CheckItem(pytest.Item):
    """A check, as pytest runs and reports it."""

    def __init__(
        self, *, check: ConformanceCheck, judge: Callable[[], CheckResult | None], **options: Any
    ) -> None:
        super().__init__(**options)
        self.check = check
        self._judge = judge
        self._result: CheckResult | None = None

    def runtest(self) -> None:
        """Run the check; raise its violation, or skip it."""
        try:
            self._result = self._judge()
        except Exception as error:  # no verdict: a lost line, a wrong option or a bug
            raise pytest.exit.Exception(str(error)) from error
        if self._result is None:
            pytest.skip("drives the channels, which was not allowed")
        if self._result.result is Result.FAILED:
            raise self._result.outcome
        if self._result.result is not Result.PASSED:
            pytest.skip(self._result.reason)

    def repr_failure(self, excinfo: Any, style: Any = None) -> str:
        """Return the text of a failure in the JUnit report."""
        return "" if self._result is None else "\n".join(self._result.details)


class CheckSession:
    """A pytest session with checks of the amplifier behind a client, and its plug-in.

    checks: with their numbers. run_in_loop: runs a coroutine of the client. may_drive: whether the
    channels may be driven; called with the number of checks that drive them, before the first one.
    on_result: called with each result. remaining: number of checks left out because they drive.
    """

    def __init__(
        self,
        checks: Sequence[tuple[int, ConformanceCheck]],
        client: JudgeClient,
        run_in_loop: Callable[[Coroutine[Any, Any, CheckResult]], CheckResult],
        *,
        level: float = DEFAULT_LEVEL,
        may_drive: Callable[[int], bool] = lambda count: True,
        on_result: Callable[[CheckResult], None] = lambda result: None,
    ) -> None:
        self.results: list[CheckResult] = []
        self.remaining = 0
        self._checks = checks
        self._kind = client.kind
        self._run = ConformanceRun(client, level)
        self._run_in_loop = run_in_loop
        self._drive_permission = may_drive
        self._on_result = on_result
        self._driving_checks = 0  # number of selected checks that drive the channels
        self._end: BaseException | None = None  # the error that ended the session early

    def run(self, *, keyword: str = "", junit_xml: Path | None = None) -> None:
        """Run the checks whose names match pytest's expression `keyword`.

        junit_xml: file for pytest's JUnit report. Raises CommandError if no check matches, and
        the error that ended the session early.
        """
        options = [*_OPTIONS, "-k", keyword]
        if junit_xml is not None:
            options.append(f"--junitxml={junit_xml}")
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
            environment.delenv("PYTEST_ADDOPTS", raising=False)
            environment.delenv("PYTEST_PLUGINS", raising=False)
            pytest.main(options, plugins=[self])
        if self._end is not None:
            raise self._end

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self, session: pytest.Session) -> bool:
        """Collect the checks, and select the matching ones."""
        items: list[CheckItem] = []
        for number, check in self._checks:
            item = CheckItem.from_parent(
                session,
                name=check.name,
                nodeid=f"{self._kind}::{check.name}",
                check=check,
                judge=lambda number=number, check=check: self._judge(number, check),
            )
            items.append(item)
        session.items = list(items)
        self._select(session)
        selected = {item.name for item in session.items}
        self._driving_checks = sum(item.check.drives for item in items if item.name in selected)
        session.testscollected = len(session.items)
        return True

    def _select(self, session: pytest.Session) -> None:
        """Let pytest remove the items that do not match; end the session if none is left."""
        try:
            session.config.hook.pytest_collection_modifyitems(
                session=session, config=session.config, items=session.items
            )
            problem = "" if session.items else "no check matches"
        except pytest.UsageError as error:
            problem = str(error)
        if problem:
            keyword = session.config.option.keyword
            raise pytest.exit.Exception(problem) from CommandError(
                f"-k must be an expression of check names, got {keyword!r}: {problem}"
            )

    def _judge(self, number: int, check: ConformanceCheck) -> CheckResult | None:
        """Run a check; return None if it is left out because it drives the channels."""
        if check.drives and not self._may_drive:
            self.remaining += 1
            return None
        result = self._run_in_loop(self._run.check(number, check))
        self.results.append(result)
        self._on_result(result)
        return result

    @cached_property
    def _may_drive(self) -> bool:
        """Whether the channels may be driven."""
        return self._drive_permission(self._driving_checks)

    def pytest_keyboard_interrupt(self, excinfo: pytest.ExceptionInfo[BaseException]) -> None:
        """Keep the error that ended the session early: an interruption, or the error of an item."""
        self._end = excinfo.value.__cause__ or excinfo.value


def judge(
    url: str,
    *,
    level: float = DEFAULT_LEVEL,
    may_drive: Callable[[int], bool],
    on_result: Callable[[CheckResult], None] = lambda result: None,
    keyword: str = "",
    junit_xml: Path | None = None,
) -> ConformanceReport:
    """Check the amplifier at a URL, and leave it silent and disarmed; see `CheckSession`.

    Raises CommandError for an invalid URL or keyword, LinkError for a line that cannot be opened or
    is lost.
    """
    with asyncio.Runner() as runner:
        connection = AsyncExitStack()
        client = runner.run(connection.enter_async_context(opened(url)))
        session = CheckSession(
            of_kind(client.kind),
            client,
            runner.run,
            level=level,
            may_drive=may_drive,
            on_result=on_result,
        )
        try:
            session.run(keyword=keyword, junit_xml=junit_xml)
        finally:
            runner.run(connection.aclose())
        return ConformanceReport(url, level, tuple(session.results), session.remaining)
