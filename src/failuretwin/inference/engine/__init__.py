"""The one likelihood: moments, theta, outcomes and an integral in the numbers of a moment.

    p(run | h) = sum over rows of p(row | h)  integral of prod over m of L_m(G_m theta + H_m z)

Read in this order; each module states its term:

    integral       one moment under one row: evidence, mean and covariance of f, in closed form
    filter         moment by moment, and every moment again given all others
    moments        settled positions -> moments
    theta          what a robot shares: registration, offsets, joint frames; scatter and noise
    outcomes       what may have become of a moment: residual and scale
    rows           what is discrete of a hypothesis; amount_rows, redrawn_rows: by signature
    picks, runs    rows by components of the robot: the evidence of every hypothesis
    posterior      what is left of onset, size and theta
    weighing       all hypotheses by runs whose theta is a mixture of normal distributions
    registration   runs of a robot that nobody has calibrated, or whose sensor may be displaced
    scatter        what moments say of how far motors scatter

Healthy, held, constant, growing and redrawn faults have rows. Faults of the way, pairs and unknown
ones are weighed at the most probable theta. Runs of calibrated robots are weighed by `movements`
and `faults`, where theta is known.
"""
