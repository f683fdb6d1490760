"""One check, tried on a few cases in every run of the tests and on thousands in the long tier."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

#: Of each check
FEW = 40


def tiers(many: int, **strategies: Any) -> Callable[[Callable[..., None]], tuple[Any, Any]]:
    """
    :param many: cases in the long tier
    :param strategies: of the check's arguments
    :return: makes of a check its test for every run, always of the same cases, and the long one, of new ones
    """

    def make(check: Callable[..., None]) -> tuple[Any, Any]:
        health = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]
        common: dict[str, Any] = {"deadline": None, "suppress_health_check": health}

        def tried(**own: Any) -> Any:
            def copied(**values: Any) -> None:  # Hypothesis marks the function that it is given
                check(**values)

            copied.__name__ = copied.__qualname__ = check.__name__
            copied.__doc__ = check.__doc__
            return settings(**common, **own)(given(**strategies)(copied))

        few = tried(max_examples=FEW, derandomize=True)
        return few, pytest.mark.long(pytest.mark.timeout(7_200)(tried(max_examples=many)))

    return make
