// Tables are sorted by the button in the heading of a column: numbers by their size, words by the alphabet; what is
// empty stays at the end.
const number = text => {
  const found = text.replace(/\u2212/g, "-").replace(/,(?=\d{3})/g, "").match(/^[+-]?\d+(\.\d+)?(e[+-]?\d+)?/i)
  return found ? Number(found[0]) : NaN
}
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0]
  table.querySelectorAll("thead th").forEach((heading, column) => {
    const button = document.createElement("button")
    button.type = "button"
    button.title = heading.title
    button.append(...heading.childNodes)
    heading.append(button)
    heading.removeAttribute("title")
    button.addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending"
      for (const other of table.querySelectorAll("thead th")) other.removeAttribute("aria-sort")
      heading.setAttribute("aria-sort", down ? "descending" : "ascending")
      const text = row => row.cells[column].textContent.trim()
      const rows = [...body.rows].filter(row => text(row) !== "–" && text(row) !== "")
      const numbers = rows.every(row => !isNaN(number(text(row))))
      const order = (a, b) => numbers ? number(text(a)) - number(text(b)) : text(a).localeCompare(text(b))
      rows.sort((a, b) => down ? order(b, a) : order(a, b))
      body.prepend(...rows)
    })
  })
}
