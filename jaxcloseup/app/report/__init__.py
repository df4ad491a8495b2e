"""Reports for people: tables, plots, pictures and the page `report.html`."""
