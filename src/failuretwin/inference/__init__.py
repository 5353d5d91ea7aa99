"""Inference: from the readings of a run to the posterior over hypotheses.

    p(h | run) ~ p(h) sum over m0, z of p(m0, z | h) prod_{m<m0} exp L_m(healthy)
                                                     prod_{m>=m0} exp L_m(phi_m(z))

with movements m, the first one m0 that a fault affects, its size z, and L_m the log density of
what was seen of a movement. Read the modules in this order; each states its term, and links its
section of docs/inference.md (words: docs/glossary.md):

    readings, log_quality    which samples were measured, and what is wrong with them
    evidence, settings       e_m, where the tool settled; transient samples on the way
    sensors                  what is believed, as one: channels in one unit
    healthy_model            where a healthy arm settles; residual and covariance S; start delay
    command_loss             w_a, which commands got lost: a hidden Markov chain; late starts
    joint_likelihood         what a movement says of the angle of one motor: a parabola
    path_likelihood          what readings say of motors that go from one pose to another
    transient_likelihood     what they say of each fault
    run_likelihood           all of it for some runs: what every hypothesis draws from
    marginal                 the sum over change point m0 and nodes z
    priors                   p(m0), ranges of sizes, odds
    fault_sizes              nodes over sizes, each with its share of the prior
    fault_models, stuck      nodes z, and the angle phi at which each puts the motor
    missed_movements         faults that leave a motor where it was: a chain of places
    double_faults, two_joint_likelihood, unknown    two motors; what no hypothesis explains
    registration, wrong_setup    the simple mistake that explains a log which fits nothing
    set_ups, log_correction  wrong set-ups, and what undoes each
    clock, set_up_weighing   how probable each is, with all faults behind it
    misfit, set_up_posterior    whether anything explains the runs, and what is believed of it
    seen_runs                runs under one set-up or several, from evidence to posterior
    posterior                evidence times prior; the diagnosis of each run
    shared_unknowns, linear_response    theta: where the sensor stands and motors rest
    shared_likelihood, shared_posterior    theta integrated out under each hypothesis
    folder_posterior         runs that say together what theta is
    fault_course             faults that stay from run to run until they are repaired
    diagnoser                BayesDiagnoser, and what any method must offer
    explanation              the verdict in words
    isolability, expected_bayes_factors    which faults a motion can tell apart
"""
