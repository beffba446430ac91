"""The runtimes: what drives a service's step, in lockstep or by the wall clock, over zenoh or in one process."""
