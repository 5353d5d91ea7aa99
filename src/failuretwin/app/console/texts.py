"""All texts of the console."""

from __future__ import annotations

TITLE = "failuretwin console"
WALL, HISTORY, CHECK, IMPORT, REPLAY = (
    "Robots",
    "History",
    "Check",
    "Import a log",
    "Replay",
)
SKIP = "Skip to content"
THEME, UNITS = "Colours", "Angles in"
THEMES = {"auto": "as the system", "light": "light", "dark": "dark"}
UNIT_NAMES = {"deg": "degrees", "rad": "radians", "counts": "servo counts"}
SIGNED_IN, SIGN_OUT = "signed in as {name} ({role})", "Sign out"
NOT_ALLOWED = "This needs the role {role}. Ask who runs the console."
EXPIRED = "Your session has ended. Sign in again."
NO_STORE = "No store is open. Start the console with --store."
NO_ROBOT = "No robot of this name is known here."
NO_PROFILE = "The profile of this robot is not known here, so its arm is not drawn."

STATES = {
    "alarm": "alarm",
    "suspected": "suspected",
    "set_up": "set-up uncertain",
    "undecided": "undecided",
    "stale": "stale",
    "waiting": "no verdict yet",
    "healthy": "healthy",
}
SIGNS = {
    "alarm": "✕",
    "suspected": "!",
    "set_up": "≠",
    "undecided": "?",
    "stale": "=",
    "waiting": "…",
    "healthy": "✓",
}
LAST_WORD = "last word: {said}"
NEVER = "nothing was heard yet"
WATCH_FAILED = "the watch has failed: {why}"
SIMULATING = "The demo simulates its year of history: {done} of {all} robots are there."
SET_UP = "{said}; set-up: {finding}"

WALL_TEXTS = {
    "search": "Search",
    "filters": {"kind": "Kind", "site": "Site", "mode": "Fault mode", "states": "State"},
    "all": "all",
    "none": "No robot matches.",
    "loading": "Loading the robots ...",
    "heard": "heard",
    "shown": "of",
    "robots": "robots",
    "states": STATES,
    "signs": SIGNS,
}

SILENT = (
    "This robot has been silent since {time}. Its last word is old: check that it is on and "
    "connected, then record a run."
)
OPEN_ALARM = (
    "The alarm {fault!r} is still open, though the last run does not show this fault. Look at "
    "this motor too. Then confirm or reject the episode, or note its repair, on the history page."
)
STILL_OPEN = "alarm still open in the store: {faults}; now: {said}"
STORED_SINCE = "open in the store since {time}: {fault}, {state} (episode {number})"
OPEN_EPISODES = "Open episodes"
VERDICT, SINCE, WHY, NEXT = "Verdict", "Since", "Why", "What to do now"
ALARM_SINCE = "alarm number {number}, since {time}"
MOTORS, MOTOR, STATE, PROBABILITY, SAYS = "Motors", "Motor", "State", "Fault probability", "Says"
ARM = "Arm: solid where it is, transparent where it was told to be"
VIEW, CORNER, FRONT, SIDE, ABOVE = "View", "Corner", "Front", "Side", "Above"
ARM_AT_REST = "Arm at rest, its motors coloured by the last run and by open episodes"
ARM_NOTE = "The solid arm is drawn from the measured tool and the suspected motor."
POSTERIOR, RESIDUALS = "Probability over time", "Residuals by motor [mm]"
TOOL, TOOL_NOTE = "Tool path [mm]", "Solid: measured; dashed: commanded."
RESIDUAL_NOTE = "What remains of the tool error if only this motor differs from its command."
TOTAL = "tool error"
ANGLES, TOLD, DRAWN = "Angles", "Told", "Drawn"
BLIND, ASK_BLIND = "What the motion could not show", "Work it out"
REACH, ASK_REACH, ANGLE = "What it can still reach", "Show", "Held at [{unit}]"
NO_MOTOR = "none"
OUT_OF_RANGE = "{motor} can stand from {low} to {high}. Fill in an angle between them."
REACHED = "{share:.0%} of the usual workspace with {motor} held at {angle}"
ALL_REACHED = "{share:.0%} of the usual workspace"
LIFE, ASK_LIFE = "Remaining life", "Estimate"
TOO_FEW = "too few runs to tell: fewer than {least} say something about its wear"
NOT_TRACKED = (
    "Cannot tell: the wear of this robot has not been tracked yet. Diagnose its logs with "
    "`failuretwin diagnose LOG --track` and this store."
)
LIFE_NOTE = "How real arms wear is not known; shapes and limit are assumed."
CHANGES, REPLAY_LIVE = "What changed", "Replay the last minutes"
READ_AT = "reading of {time}"
STREAM_TIME = "{time:.1f} s"
WORKING, NOTHING = "Working ...", "nothing"

RUNS, WHEN, RUN, PLAY = "Runs", "When", "Run", "Replay"
NO_LOG = "The log of this run is not on this computer. Put it back, or import it, to replay it."
NO_LOGS = (
    "Runs without links have no log on this computer: they were watched or simulated, or their log "
    "was moved. Put a log back, or import it, to replay it."
)
SLIDER = "Time in the run"
REPORT = "Page for technicians"
PAUSE = "Pause"

EPISODES, EPISODE, FAULT, FINDING = "Fault episodes", "Episode", "Fault", "Finding"
TIMELINE, EVENT = "Timeline", "Event"
YOUR_NAME, NOTE, CAUSE, PART = "Your name", "Note", "Cause", "Part"
FILL_IN = "Fill in the field {label!r} first."
CONFIRM, REJECT, OTHER, UNDO = "Confirm", "Reject", "Other cause", "Undo"
NOTE_REPAIR, REPAIR, UNDO_REPAIR = "Note a repair", "Repair", "Undo its last repair"
RATES = "Learned rates of faults"
RATE_NOTE = (
    "All robots of this kind teach a rate, while their motor is about as old as that of this "
    "robot. Age counts from the last repair, else from the first run."
)
RATE_COLUMNS = (
    *("Fault", "Age of the motor", "Confirmed at this age", "Days at this age"),
    *("Rate in 1000 h", "Times the assumed rate"),
)
COMPARE, THEN, NOW = "Compare two dates", "Then", "Now"
OFFSET, CHANGE = "Offset", "Change"
NO_OFFSETS = "No offsets are stored. `check` and `diagnose --track` store them."
STORED = "stored"

CHECK_NOTE = "Test movements on {place}, behind the same gates as `failuretwin check`."
EMULATED_ARM, REAL_ARM = "this emulated arm", "the real arm at {place}"
REHEARSAL = (
    "Test movements on a healthy emulated {kind}: they say nothing of {name}, and are not stored."
)
A_ROBOT, EMULATED = "a robot", "an emulated {kind}"
SECONDS_RANGE = "Seconds: got {got}, expected {low:g} to {high:g}."
NO_MOVE = "The real arm is not moved: the server was started without --move."
SECONDS, START, STOP = "Seconds", "Start the check", "STOP"
START_NOT_ALLOWED = "Starting a check needs the role {role}. Everybody may stop one."
STOP_NOTE = "No emergency stop: keep the real one in reach. It works from any window: /stop"
STOPPED_BY, THIS_COMPUTER = "stopped by {name}", "somebody on this computer"
STOP_SENT, NO_CHECK = "Told to stop.", "No check is running."
HANG = "the console hangs"
GONE = "the page that started the check is closed, or hangs"
BUSY = "A check is running. Wait for it, or stop it."
STARTED, FINISHED = "the check of {robot} has begun", "the check is over"

DROP = "Drop a log here, or choose one ({endings})"
DROP_LABEL = "Log file"
READING = "Reading {name} ..."
REFUSED = "refused: {why}"
REJECTED = "The file is {limit}. Record a shorter log, or split it."
OTHER_ENDING = "{name} is no log that can be read here. Expected a file that ends in {endings}."
COLUMNS, READ_AGAIN = "Columns", "Read it again"
FIELDS = {
    "Add --columns MAP.toml: if that file does not exist yet, a guess is written there for you to "
    "check.": f"The field {COLUMNS!r} below holds a guess: correct it, then read the log again.",
    "a TOML file for --columns or in BagTopics in Python": f"the field {COLUMNS!r} below",
    "--columns MAP.toml": f"the field {COLUMNS!r} below",
    "--robot": "the field 'Profile'",
    "columns.toml": f"field {COLUMNS!r}",
}
"""Fields of the page for logs, by the words of errors that mean them."""
TOO_LARGE = "larger than {limit} MB"
ROBOT_NAME, PROFILE = "Name of the robot in the store", "Profile"
NO_NAME = "Not stored: no robot is named. Fill in its name above, then drop the log again."
NOT_BY_YOU = "Not stored: your role is {role!r}. Ask somebody whose role is 'confirm' to import it."
NOWHERE_TO_STORE = "Not stored: no store is open. Start the console with --store."

LOGIN, NAME, PASSWORD, SIGN_IN = "Sign in", "Name", "Password", "Sign in"
WRONG = "Name or password is wrong."
TOO_OFTEN = "Too many tries. Wait a minute."
FOREIGN = "refused: the request comes from another site, or names another host"
FLOOD = "refused: too many events"
