"""Behind the fit: recordings are watched, the alarm is set on some and judged on others."""
