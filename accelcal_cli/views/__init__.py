"""Views: results as tables, headings and number formats for every kind of result."""
