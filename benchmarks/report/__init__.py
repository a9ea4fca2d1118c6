"""Reports: tables, charts, pictures, pages."""
