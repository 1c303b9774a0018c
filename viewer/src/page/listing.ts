// Starts the page that lists the scenes of a server.
import { showList } from "./list.ts";

void showList();
