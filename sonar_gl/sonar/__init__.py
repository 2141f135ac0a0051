"""The instrument: data sheet, fan of views, sectors and sampling."""
