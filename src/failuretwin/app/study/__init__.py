"""The paper's study from end to end: data, trainings, tables, pictures, one page."""
