// Of a page of finished runs: what `film` has of the moment at the slider, and `choices` of the chosen region, is put
// into the sources of the page.
const put = (source, table, name, columns, row) => {
  for (const column of columns) source.data[column] = table.data[`${name}.${column}`][row]
  source.change.emit()
}
const k = Math.round(slider.value / slider.step)
if (cb_obj === region) {
  const r = Number(region.value)
  for (const [name, source, columns] of chosen) put(source, choices, name, columns, r)
  titles.forEach((title, n) => { title.text = choices.data[`title${n}`][r] })
}
for (const [name, source, columns] of moving) put(source, film, name, columns, k)
numbers.text = film.data.text[k]
for (const span of spans) span.location = slider.value
lines.forEach((line, n) => {
  const begin = Math.max(1, k + 1 - trail)
  const [x, y] = [line.data.accumulation.slice(begin, k + 1), line.data.outflow.slice(begin, k + 1)]
  trails[n].data = {x, y}
  points[n].data = {x: x.slice(-1), y: y.slice(-1)}
})
