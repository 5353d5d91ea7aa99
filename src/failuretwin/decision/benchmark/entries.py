"""Entries of the benchmark: classes that learn from what a track allows and answer test runs.

An entry is a class named ``module:Class``, of one of two kinds:

- a scikit-learn classifier: made without arguments, `fit(X, y)`, `predict_proba(X)`, `classes_`; on
  track P1 also `adapt(X)`, which receives the test runs without labels;
- a diagnoser: made with the digital twin, `diagnose(runs)`, and `fit(runs)` if it learns.

X is (run, 100 times channel): at each tenth of a second the commands [rad], the measured position
[m], and the measured minus the commanded position [m].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from failuretwin.core.errors import InputError, check_name, needs_extra
from failuretwin.core.hypothesis import PAPER_MODES, Diagnosis, single_faults
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.benchmark.tasks import diagnoses_of
from failuretwin.decision.learned.feature_encoder import (
    augmented_features,
    original_features,
    signals_of,
)
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import (
    checked_posterior,
    class_from_text,
    diagnoser_from_text,
)

if TYPE_CHECKING:
    import xarray as xr

HERE = "failuretwin.decision.benchmark.baselines"
RIVALS = "failuretwin.decision.rivals.classical"
BASELINES = {
    "chance": f"{HERE}:Chance",
    "nearest": f"{RIVALS}:NearestSimulation",
    "boosting": f"{RIVALS}:GradientBoosting",
    "minirocket": f"{RIVALS}:MiniRocket",
    "kalman": f"{HERE}:KalmanBank",
    "bayes": f"{HERE}:Bayes",
}
"""Entries that come with the package."""


class NotEnteredError(Exception):
    """The entry does not take part on this track."""


class Entry(Protocol):
    """What the runner needs of an entry."""

    def fit(self, runs: xr.Dataset) -> object:
        """Learn from the runs that the track allows; without `fault`: of unknown state."""
        ...

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run."""
        ...


def features_of(runs: xr.Dataset, twin: DigitalTwin) -> FloatArray:
    """Return the features of runs for classifiers, (run, 100 times channel)."""
    signals = signals_of(runs)
    beyond = augmented_features(twin, signals)[..., 3:]
    channels = np.concatenate([original_features(signals), beyond], axis=-1)
    return channels.reshape(len(channels), -1)


class Classifier:
    """A scikit-learn classifier as an entry; it is fitted when the first answer is wanted."""

    def __init__(
        self, kind: type[Any], twin: DigitalTwin, train: Callable[[], xr.Dataset], name: str
    ) -> None:
        self._made, self._twin, self._train, self._name = _made(kind, name), twin, train, name
        self._known: list[xr.Dataset] = []
        self._fitted = False

    def fit(self, runs: xr.Dataset) -> None:
        """Keep labelled runs for training, or adapt to runs of unknown state."""
        if "fault" in runs:
            self._known.append(runs)
            return
        if not hasattr(self._made, "adapt"):
            raise NotEnteredError
        self._learn()
        self._made.adapt(features_of(runs, self._twin))

    def _learn(self) -> None:
        if self._fitted:
            return
        sets = [self._train(), *self._known]
        features = np.concatenate([features_of(runs, self._twin) for runs in sets])
        truth = np.array([fault for runs in sets for fault in truth_of(runs) or []])
        self._made.fit(features, truth)
        self._fitted = True

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the probabilities of the classifier as diagnoses."""
        self._learn()
        chances = np.asarray(self._made.predict_proba(features_of(runs, self._twin)))
        names = self._classes
        if chances.shape != (runs.sizes["run"], len(names)):
            raise InputError(
                f"{self._name}: predict_proba(X) gave shape {chances.shape}. Expected one row per "
                f"run and one column per class, ({runs.sizes['run']}, {len(names)})."
            )
        found = diagnoses_of(runs, names, chances)
        return [replace(one, posterior=checked_posterior(one, self._name)) for one in found]

    @property
    def _classes(self) -> list[str]:
        """The classes that the columns of predict_proba mean."""
        if not hasattr(self._made, "classes_"):
            raise InputError(
                f"{self._name}: has no `classes_` after fit(X, y). Expected the labels of y in the "
                "order of the columns of predict_proba(X)."
            )
        names = [str(name) for name in self._made.classes_]
        labels = [str(h) for h in single_faults(self._twin.robot.motor_names, PAPER_MODES)]
        for name in names:
            check_name("label", name, labels, f"{self._name}: classes_: ")
        return names


def _made(kind: type[Any], name: str) -> Any:
    try:
        made = kind()
    except TypeError as error:
        raise InputError(
            f"{name}: cannot be made without arguments ({error}). Expected a default for each "
            "argument of __init__."
        ) from error
    if not callable(getattr(made, "fit", None)):
        raise InputError(f"{name}: has no method `fit`. Expected fit(X, y).")
    return made


class Diagnosing:
    """A class with `diagnose` as an entry; its answers are checked."""

    def __init__(self, text: str, twin: DigitalTwin) -> None:
        self._checked = diagnoser_from_text(text, twin)
        self._own = self._checked.diagnoser

    def fit(self, runs: xr.Dataset) -> None:
        """Hand the runs to the class."""
        if not hasattr(self._own, "fit"):
            raise NotEnteredError
        self._own.fit(runs)

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the checked diagnoses of the class."""
        return self._checked.diagnose(runs)


def entry_of(method: str, twin: DigitalTwin, train: Callable[[], xr.Dataset]) -> Entry:
    """Return a new entry by the name of a baseline or ``module:Class``.

    `train` returns the labelled training runs, which classifiers learn from.

    Raises:
        InputError: If there is no such class, or it is of neither kind.
    """
    text = BASELINES.get(method, method)
    if ":" not in text:
        raise InputError(
            f"--method {method}: expected module:Class or one of {', '.join(BASELINES)}."
        )
    if text.startswith(RIVALS) or text.startswith("sklearn."):
        with needs_extra("classifiers need scikit-learn", "learn"):
            import sklearn  # noqa: F401
    kind = class_from_text(text)
    if hasattr(kind, "diagnose"):
        return Diagnosing(text, twin)
    if hasattr(kind, "predict_proba"):
        return Classifier(kind, twin, train, text)
    raise InputError(
        f"{text}: has neither `predict_proba` nor `diagnose`. Expected a classifier with "
        "fit(X, y) and predict_proba(X), or a class with diagnose(runs). scikit-learn's "
        "CalibratedClassifierCV adds predict_proba to a classifier."
    )


def named_runs(runs: xr.Dataset, hypotheses: Sequence[str]) -> xr.Dataset:
    """Return runs that state the names that an answer may use."""
    return runs.assign_attrs(hypotheses=",".join(hypotheses))
