"""What people read: tables, plots, pictures and the report's page."""
