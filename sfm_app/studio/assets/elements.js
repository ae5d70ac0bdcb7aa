// An element: properties, attributes where they have a dash, listeners where they begin with "on"; then what it contains.
export function make(tag, properties = {}, ...content) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name.includes("-") || name === "role" || name === "for") element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...content.filter((one) => one !== null && one !== undefined && one !== "" && one !== false));
  return element;
}
