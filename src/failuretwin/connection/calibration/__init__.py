"""The twin learns its robot: from healthy logs to imperfections with error bars."""
