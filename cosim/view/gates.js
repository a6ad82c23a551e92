const closer = cb_obj.end - cb_obj.start < limit
for (const part of far) part.visible = !closer
for (const part of near) part.visible = closer
