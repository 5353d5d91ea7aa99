"""Inference: from the readings of a run to the posterior over hypotheses.

    p(h | run) ~ p(h) sum over m0, z of p(m0, z | h) prod_{m<m0} exp L_m(healthy)
                                                     prod_{m>=m0} exp L_m(phi_m(z))

with movements m, the first one m0 that a fault affects, its size z, and L_m the log density of
what was seen of a movement. Read the modules in this order; each states its term, and links its
section of docs/inference.md (words: docs/glossary.md):

    observation/    readings -> settled positions e_m; sensors; the healthy robot: residual and
                    covariance S; lost commands w_a
    movements/      L_m: what a movement says of the angles of the motors
    faults/         a file a signature: change point m0, nodes z, their prior; pairs, unknown
    engine/         evidence of runs of every robot: theta integrated out, moment by moment
    theta/          what movements share (registration, offsets), integrated out
    set_ups/        wrong set-ups of a log, and what undoes each
    together/       folders, lives and streams of one robot
    posterior       evidence times prior; the diagnosis of each run
    set_up_weighing, set_up_posterior, misfit    how probable each set-up is
    seen_runs       runs under one set-up or several, from evidence to posterior
    diagnoser       BayesDiagnoser, and what any method must offer
    explanation, advice     the verdict in words
    isolability, expected_bayes_factors    which faults a motion can tell apart
"""
