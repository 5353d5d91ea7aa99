"""Methods of others on equal terms: classifiers, networks, and the study that compares them."""
