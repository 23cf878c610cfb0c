"""The laboratory: oracle, hard cases, the model of the RT core, benchmarks, Mitsuba beside wrt. The product never imports it."""
