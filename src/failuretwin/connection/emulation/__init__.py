"""A robot that exists only as physics, for trying the live loop without one."""
