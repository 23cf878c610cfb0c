"""The laboratory: oracle, hard cases, model of the RT core, benchmarks, comparison with Mitsuba. Rendering never imports it."""
