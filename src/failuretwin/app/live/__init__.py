"""The live shadow: a robot is listened to, diagnosed at every sample, and shown."""
