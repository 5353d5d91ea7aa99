"""How good diagnoses are, where the truth is known.

`proportions` counts: right or wrong, false alarms, coverage of intervals, delays. `scoring_rules`
is about probabilities: what they are worth, whether they mean what they say (reliability,
simulation-based calibration), and which of two methods is better.
"""

from failuretwin.decision.metrics.proportions import (
    NO_VERDICT as NO_VERDICT,
)
from failuretwin.decision.metrics.proportions import (
    Alarms as Alarms,
)
from failuretwin.decision.metrics.proportions import (
    ClassScore as ClassScore,
)
from failuretwin.decision.metrics.proportions import (
    Coverage as Coverage,
)
from failuretwin.decision.metrics.proportions import (
    Delays as Delays,
)
from failuretwin.decision.metrics.proportions import (
    IntervalCase as IntervalCase,
)
from failuretwin.decision.metrics.proportions import (
    Scores as Scores,
)
from failuretwin.decision.metrics.proportions import (
    Share as Share,
)
from failuretwin.decision.metrics.proportions import (
    alarm_threshold as alarm_threshold,
)
from failuretwin.decision.metrics.proportions import (
    count_alarms as count_alarms,
)
from failuretwin.decision.metrics.proportions import (
    coverage_by_mode as coverage_by_mode,
)
from failuretwin.decision.metrics.proportions import (
    delays_after_onset as delays_after_onset,
)
from failuretwin.decision.metrics.proportions import (
    judged_truth as judged_truth,
)
from failuretwin.decision.metrics.proportions import (
    score as score,
)
from failuretwin.decision.metrics.proportions import (
    wilson_interval as wilson_interval,
)
from failuretwin.decision.metrics.scoring_rules import (
    EcdfBand as EcdfBand,
)
from failuretwin.decision.metrics.scoring_rules import (
    LogScore as LogScore,
)
from failuretwin.decision.metrics.scoring_rules import (
    LogScoreGain as LogScoreGain,
)
from failuretwin.decision.metrics.scoring_rules import (
    McNemar as McNemar,
)
from failuretwin.decision.metrics.scoring_rules import (
    RankCheck as RankCheck,
)
from failuretwin.decision.metrics.scoring_rules import (
    Reliability as Reliability,
)
from failuretwin.decision.metrics.scoring_rules import (
    adaptive_edges as adaptive_edges,
)
from failuretwin.decision.metrics.scoring_rules import (
    brier_score as brier_score,
)
from failuretwin.decision.metrics.scoring_rules import (
    calibrated_error as calibrated_error,
)
from failuretwin.decision.metrics.scoring_rules import (
    check_ranks as check_ranks,
)
from failuretwin.decision.metrics.scoring_rules import (
    equal_edges as equal_edges,
)
from failuretwin.decision.metrics.scoring_rules import (
    log_score as log_score,
)
from failuretwin.decision.metrics.scoring_rules import (
    log_score_gain as log_score_gain,
)
from failuretwin.decision.metrics.scoring_rules import (
    mcnemar as mcnemar,
)
from failuretwin.decision.metrics.scoring_rules import (
    rank_of_truth as rank_of_truth,
)
from failuretwin.decision.metrics.scoring_rules import (
    reliability as reliability,
)
