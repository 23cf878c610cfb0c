"""The same scene in Mitsuba 3: translated, rendered, compared."""
