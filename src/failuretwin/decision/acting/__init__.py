"""Acting: commands that bring the tool where it should be, by what is believed of the arm."""
